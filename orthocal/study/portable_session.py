"""A session and its robot in a form that can be sent to workers on any machine."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from orthocal.effects.loading import load_robot
from orthocal.errors import RobotError
from orthocal.io.files import is_folder, read_file
from orthocal.measurement.files.write_session import session_document
from orthocal.robot.loading import packaged_robots
from orthocal.robot.model import Robot
from orthocal.session.session import Session


@dataclass(frozen=True, slots=True)
class PortableRobot:
    """Files of a robot."""

    name: str
    folder: str
    """Directory of the files; where it does not exist, the robot is loaded from their content."""
    sha256: str
    urdf: bytes
    description: bytes
    tolerances: tuple[tuple[str, float], ...] = ()
    """Prior standard deviations that a session states in place of the robot's."""

    @classmethod
    def of(cls, robot: Robot) -> PortableRobot:
        """Files of a nominal robot.

        Raises:
            RobotError: If a file cannot be read any more.
        """
        urdf, description = (read_file(p, error=RobotError) for p in (robot.urdf, robot.yaml))
        folder = str(robot.folder.resolve())
        stated = tuple(robot.parameters.stated.items())
        return cls(robot.name, folder, robot.sha256, urdf, description, stated)

    def unpack(self) -> Robot:
        """The robot, from its directory if the files there are unchanged."""
        return _unpack(self).with_tolerances(dict(self.tolerances))


@lru_cache(maxsize=4)
def _unpack(portable: PortableRobot) -> Robot:
    packaged = packaged_robots()
    folder = Path(portable.folder)
    sources: list[str | Path] = [portable.name] if portable.name in packaged else []
    sources += [folder] if is_folder(folder) else []
    for source in sources:
        robot = load_robot(source)
        if robot.sha256 == portable.sha256:
            return robot
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above) / portable.name
        folder.mkdir()
        (folder / f"{portable.name}.urdf").write_bytes(portable.urdf)
        (folder / f"{portable.name}.yaml").write_bytes(portable.description)
        return load_robot(folder)


@dataclass(frozen=True, slots=True, eq=False)
class PortableSession:
    """A session, with the files of its robot in place of the robot."""

    robot: PortableRobot
    session: Session
    """Without its robot."""

    @classmethod
    def of(cls, session: Session) -> PortableSession:
        """A session of a nominal robot."""
        no_robot: Any = None  # `unpack` restores it
        return cls(PortableRobot.of(session.robot), replace(session, robot=no_robot, parts=()))

    def unpack(self) -> Session:
        """The session, with its robot."""
        return replace(self.session, robot=self.robot.unpack())

    @property
    def record(self) -> dict[str, Any]:
        """The session as plain data, without the locations of its files."""
        session = self.unpack()
        document = session_document(session)
        document["robot"] = self.robot.name
        rows = "\n".join(
            f"{r.setup},{r.posture},{r.minus or ''},{r.cycle},{r.value!r}"
            + (f",{r.conditions}" if r.conditions else "")
            for r in session.readings
        )
        return {
            "robot": {"name": self.robot.name, "sha256": self.robot.sha256},
            "session": document,
            "readings": hashlib.sha256(rows.encode()).hexdigest(),
        }
