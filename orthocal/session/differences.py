"""Independence of the readings and differences of one cycle of a setup."""

from __future__ import annotations

from orthocal.errors import SessionError
from orthocal.session.session import Reading

Node = tuple[str, int, str]
"""Setup, cycle and posture."""


class IndependentReadings:
    """Readings and differences of which none follows from others of its setup and cycle."""

    def __init__(self) -> None:
        self._absolute: set[tuple[str, int]] = set()
        self._relative: set[tuple[str, int]] = set()
        self._leaders: dict[Node, Node] = {}

    def add(self, reading: Reading) -> None:
        """Add a reading of a posture, or a difference; not one of a pair of postures.

        Raises:
            SessionError: If it is a linear combination of previous differences, or if its cycle
                contains both readings and differences.
        """
        group = (reading.setup, reading.cycle)
        if reading.minus is None:
            self._absolute.add(group)
        else:
            self._relative.add(group)
            if not connect(self._leaders, (*group, reading.posture), (*group, reading.minus)):
                raise SessionError(
                    f"{reading.label} follows from the other differences of setup "
                    f"{reading.setup} in cycle {reading.cycle}; delete it, or use another cycle "
                    "if it was measured separately"
                )
        if group in self._absolute and group in self._relative:
            raise SessionError(
                f"setup {reading.setup} has both readings and differences in cycle "
                f"{reading.cycle}; keep the readings only"
            )


def connect(leaders: dict[Node, Node], first: Node, second: Node) -> bool:
    """Connect two nodes by a difference; False if others connect them already."""
    first, second = find_leader(leaders, first), find_leader(leaders, second)
    leaders[first] = second
    return first != second


def find_leader(leaders: dict[Node, Node], node: Node) -> Node:
    """Union-find root of a node among nodes that differences connect (path halving)."""
    while (parent := leaders.get(node, node)) != node:
        leaders[node] = leaders.get(parent, parent)
        node = parent
    return node
