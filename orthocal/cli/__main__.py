"""python -m orthocal.cli."""

from __future__ import annotations

from orthocal.cli import main

main()
