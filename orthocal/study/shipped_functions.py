"""A session and its robot as a worker gets them, in whichever process and on whichever machine."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from orthocal.errors import RobotError
from orthocal.io.files import is_folder, read_file
from orthocal.measurement.files.write_session import session_document
from orthocal.robot.loading import load_robot, packaged_robots
from orthocal.robot.model import Robot
from orthocal.session.session import Session


@dataclass(frozen=True, slots=True)
class ShippedRobot:
    """The files of a robot."""

    name: str
    folder: str
    """Where it is; elsewhere it is made of the files."""
    sha256: str
    urdf: bytes
    description: bytes
    tolerances: tuple[tuple[str, float], ...] = ()
    """Other ones than its files', as a session states them."""

    @classmethod
    def of(cls, robot: Robot) -> ShippedRobot:
        """The files of a nominal robot.

        Raises:
            RobotError: If they cannot be read any more.
        """
        urdf, description = (read_file(p, error=RobotError) for p in (robot.urdf, robot.yaml))
        folder = str(robot.folder.resolve())
        stated = tuple(robot.parameters.stated.items())
        return cls(robot.name, folder, robot.sha256, urdf, description, stated)

    def unpack(self) -> Robot:
        """The robot; that which is there where nothing has changed."""
        return _unpack(self).with_tolerances(dict(self.tolerances))


@lru_cache(maxsize=4)
def _unpack(shipped: ShippedRobot) -> Robot:
    packaged = packaged_robots()
    for there in (shipped.name if shipped.name in packaged else None, Path(shipped.folder)):
        if there is None or (isinstance(there, Path) and not is_folder(there)):
            continue
        robot = load_robot(there)
        if robot.sha256 == shipped.sha256:
            return robot
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above) / shipped.name
        folder.mkdir()
        (folder / f"{shipped.name}.urdf").write_bytes(shipped.urdf)
        (folder / f"{shipped.name}.yaml").write_bytes(shipped.description)
        return load_robot(folder)


@dataclass(frozen=True, slots=True, eq=False)
class ShippedSession:
    """A session without its robot, and that robot's files."""

    robot: ShippedRobot
    rest: Session

    @classmethod
    def of(cls, session: Session) -> ShippedSession:
        """A session of a nominal robot."""
        bare: Any = None  # put back by `unpack`
        return cls(ShippedRobot.of(session.robot), replace(session, robot=bare, parts=()))

    def unpack(self) -> Session:
        """The session, with its robot."""
        return replace(self.rest, robot=self.robot.unpack())

    @property
    def record(self) -> dict[str, Any]:
        """What it is, as plain data: what was measured by what it is, not by where it lies."""
        session = self.unpack()
        document = session_document(session)
        document["robot"] = self.robot.name
        rows = "\n".join(
            f"{r.setup},{r.posture},{r.minus or ''},{r.cycle},{r.value!r}" for r in session.readings
        )
        return {
            "robot": {"name": self.robot.name, "sha256": self.robot.sha256},
            "session": document,
            "readings": hashlib.sha256(rows.encode()).hexdigest(),
        }
