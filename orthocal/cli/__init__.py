"""The command line. The only place that prints, and that turns errors into exit codes.

Imports of anything slow stand inside the commands: help answers at once.
"""

from __future__ import annotations

from orthocal.cli.options import app
from orthocal.cli.run import main

__all__ = ["app", "main"]
