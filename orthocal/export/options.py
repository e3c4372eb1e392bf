"""What whoever exports may ask for beside the format."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from orthocal.errors import ParameterError
from orthocal.units import MM, UM

FARTHEST_TOOL = 10.0
"""No tool is longer: it is a wrong unit, [m]."""

WITHIN = 0.1 * UM
"""What a kinematics module keeps to unless something else is asked for, [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Of a format that has them; None where nothing was asked for.

    Raises:
        ParameterError: If a number can be none.
    """

    within: float | None = None
    """By how much a kinematics module may miss the calibrated machine's tool, [m]."""
    tool: tuple[float, float, float] | None = None
    """Tip of the tool in the frame of the robot's tool centre point, [m]."""
    home_offsets: tuple[float, ...] | None = None
    """HOME_OFFSET of each joint while measuring, [m, rad]."""
    half_side: float | None = None
    """Half the side of the region around the zero, [m]."""
    module: bool | None = None
    """Whether a kinematics module is made, or HOME_OFFSET told; by default a module where more than
    offsets was identified."""

    def __post_init__(self) -> None:
        if self.within is not None and not 0.0 < self.within < math.inf:
            raise ParameterError(
                f"found {self.within / UM:g} µm; expected more than 0", where="--within"
            )
        if self.tool is not None and not all(abs(v) <= FARTHEST_TOOL for v in self.tool):
            raise ParameterError(
                f"found {', '.join(f'{v / MM:g}' for v in self.tool)} mm; "
                f"expected numbers of at most {FARTHEST_TOOL / MM:g} mm",
                where="--tool",
            )
        if self.home_offsets is not None and not all(map(math.isfinite, self.home_offsets)):
            raise ParameterError("expected finite numbers", where="--home-offset")
        if self.half_side is not None and not 0.0 < self.half_side < math.inf:
            raise ParameterError(
                f"found {self.half_side / MM:g} mm; expected more than 0", where="--half-side-mm"
            )

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the options that were given."""
        names = (f.name for f in fields(self))
        return tuple(n for n in names if getattr(self, n) is not None)
