"""orthocal: calibration of Orthoglide-type parallel robots from dial-indicator readings.

Five lines do the main job:

    import orthocal

    session = orthocal.load_session("examples/table1/experiment-2")
    calibration = orthocal.calibrate(session)
    print(orthocal.summarize(calibration))
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")

_MODULES = {name: module for module, name in re.findall(r"(?m)^from (\S+) import (\w+) as", _STUB)}
"""Public names and their modules, from the list that type checkers read."""

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any public name
    """Import a public name on first use, so that start-up stays fast."""
    if name not in _MODULES:
        raise AttributeError(f"module 'orthocal' has no attribute '{name}'")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
