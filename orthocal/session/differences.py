"""Independence of the readings and differences of one cycle of a setup."""

from __future__ import annotations

from orthocal.errors import SessionError
from orthocal.session.session import Reading


class IndependentReadings:
    """Readings and differences of which none follows from others of its setup and cycle."""

    def __init__(self) -> None:
        self._absolute: set[tuple[str, int]] = set()
        self._differences: dict[tuple[str, int], dict[str, str]] = {}

    def add(self, reading: Reading, where: str) -> None:
        """Add a reading of a posture, or a difference; not one of a pair of postures.

        Args:
            reading: The reading.
            where: File and line, for messages.

        Raises:
            SessionError: If it is a linear combination of previous differences, or if its cycle
                contains both readings and differences.
        """
        group = (reading.setup, reading.cycle)
        if reading.minus is None:
            self._absolute.add(group)
        else:
            leaders = self._differences.setdefault(group, {})
            first, second = (_find_leader(leaders, n) for n in (reading.posture, reading.minus))
            if first == second:
                raise SessionError(
                    f"{reading.label} follows from the other differences of setup "
                    f"{reading.setup} in cycle {reading.cycle}; delete it, or use another cycle "
                    "if it was measured separately",
                    where=where,
                )
            leaders[first] = second
        if group in self._absolute and group in self._differences:
            raise SessionError(
                f"setup {reading.setup} has both readings and differences in cycle "
                f"{reading.cycle}; keep the readings only",
                where=where,
            )


def _find_leader(leaders: dict[str, str], name: str) -> str:
    """Union-find root of a posture among postures that differences connect (path halving)."""
    while (parent := leaders.get(name, name)) != name:
        leaders[name] = leaders.get(parent, parent)
        name = parent
    return name
