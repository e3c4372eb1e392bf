"""Execution of a command, and exit codes for errors."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from typing import Annotated

import typer
from typer import Option
from typer.models import CommandInfo, TyperInfo

import orthocal
from orthocal.cli.options import app
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import OrthocalError
from orthocal.runtime.interrupts import INTERRUPTED, ending_at_interrupt
from orthocal.runtime.streams import ReaderGoneError, announced_if_slow, guarded_streams
from orthocal.runtime.threads import state_one_thread
from orthocal.text import printable

PANELS = {
    "Prepare": ("new", "plan"),
    "Measure": ("sheet", "record", "import", "trace", "simulate", "check"),
    "Calibrate": ("calibrate", "compare", "report", "validate", "again"),
    "Use": ("forward", "inverse", "accuracy", "adjust", "correct", "export", "view"),
    "Study": ("study",),
}
"""Panels of `orthocal --help` and their commands, in the order of work."""

MODULES = {"import": "import_", "inverse": "forward"}
"""Modules of commands whose names are others: `import` is a reserved word of Python."""


SLOW = frozenset(
    "check trace simulate calibrate compare report validate again accuracy adjust correct export "
    "view".split()
)
"""Commands that may need more than some seconds and print no progress."""


def main() -> None:
    """Run the command line without tracebacks.

    Exit codes: 0 done; 1 the solver did not converge, or an output cannot be written; 2 bad input;
    3 the verdict is `review` or `reject`, a calibration is not confirmed, or some rows of a table
    cannot be reached; 70 a bug of orthocal; 130 Ctrl-C.
    """
    state_one_thread()
    # otherwise pydantic searches all installed packages for plugins
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    with guarded_streams(), ending_at_interrupt():
        code = _run()
    sys.exit(code)


def make_program(called: str = "") -> typer.Typer:
    """Program with all commands in the order of work, or with the called command only."""
    panels = {name: panel for panel, names in PANELS.items() for name in names}
    chosen = [called] if called in panels else list(panels)
    for name in chosen:
        import_module(f"orthocal.cli.{MODULES.get(name, name)}")
    commands = {c.name or getattr(c.callback, "__name__", ""): c for c in app.registered_commands}
    groups = {g.name: g for g in app.registered_groups}
    for name in chosen:
        info: CommandInfo | TyperInfo = commands.get(name) or groups[name]
        info.rich_help_panel = panels[name]
    program = copy.copy(app)
    program.registered_commands = [commands[name] for name in chosen if name in commands]
    program.registered_groups = [groups[name] for name in chosen if name in groups]
    return program


def _run() -> int | str | None:
    """Run the command, and return its exit code."""
    code: int | str | None = 0
    try:
        try:
            with _announced(sys.argv[1:]):
                make_program(*sys.argv[1:2])()
        except SystemExit as e:
            code = e.code
        sys.stdout.flush()
    except ReaderGoneError:
        pass
    except OrthocalError as e:
        put_note(f"orthocal: {e}")
        code = e.exit_code
    except KeyboardInterrupt:
        code = INTERRUPTED
    except MemoryError:
        put_note("orthocal: there is not enough memory for an input of this size")
        code = 1
    except Exception as e:
        if os.environ.get("ORTHOCAL_DEBUG"):
            raise
        put_note(
            "orthocal: this is a bug of orthocal, not of your input: "
            f"{printable(f'{type(e).__name__}: {e}')}\n"
            "Set ORTHOCAL_DEBUG=1 to print its traceback, and report it."
        )
        code = 70
    return code


def _announced(words: Sequence[str]) -> AbstractContextManager[None]:
    """Line on the terminal if a command works for a long time without output.

    Args:
        words: The command and its arguments.
    """
    serves = words[:1] == ["view"] and not {"--html", "--png"} & set(words)
    if serves or not words or words[0] not in SLOW:
        return nullcontext()
    return announced_if_slow(f"orthocal: {words[0]} is working; this may take half a minute")


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        put_out(orthocal.__version__)
        raise typer.Exit
