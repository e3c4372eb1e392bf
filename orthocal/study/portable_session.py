"""A session and its robot in a form that can be sent to workers on any machine."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from orthocal.effects.loading import load_robot_content
from orthocal.measurement.files.write_session import session_document
from orthocal.robot.model import Robot
from orthocal.session.session import Session


@dataclass(frozen=True, slots=True)
class PortableRobot:
    """Files of a robot."""

    name: str
    folder: Path | None
    """Directory of the files, for messages."""
    sha256: str
    content: tuple[tuple[str, bytes], ...]
    """Names and contents of the files."""
    tolerances: tuple[tuple[str, float], ...] = ()
    """Prior standard deviations that a session states in place of the robot's."""

    @classmethod
    def of(cls, robot: Robot) -> PortableRobot:
        """Files of a nominal robot."""
        stated = tuple(robot.parameters.stated.items())
        content = tuple(robot.content.items())
        return cls(robot.name, robot.folder, robot.sha256, content, stated)

    def unpack(self) -> Robot:
        """The robot."""
        robot = load_robot_content(self.name, dict(self.content), folder=self.folder)
        return robot.with_tolerances(dict(self.tolerances))


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
