"""Command line: the only package that prints, and that turns errors into exit codes.

Commands import slow modules when they are called, so that help appears at once.
"""

from __future__ import annotations

from orthocal.cli.run import main, make_program

__all__ = ["main", "make_program"]
