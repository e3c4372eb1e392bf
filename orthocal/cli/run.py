"""Running a command, and turning errors into exit codes."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

import orthocal

# what registers the commands, in the order in which help lists them
from orthocal.cli import (  # noqa: F401
    again,
    calibrate,
    check,
    correct,
    export,
    import_,
    machine,
    new,
    plan,
    record,
    sheet,
    simulate,
    study,
    view,
)
from orthocal.cli.options import app
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import OrthocalError
from orthocal.runtime.interrupts import INTERRUPTED, ending_at_interrupt
from orthocal.runtime.streams import ReaderGoneError, guarded_streams
from orthocal.text import printable


def main() -> None:
    """Run the command line; no traceback ever reaches a user.

    Exit codes: 0 done, 1 a solve did not converge or an output cannot be written, 2 bad input,
    3 the verdict is to review or to reject the readings, a calibration is not confirmed, or some
    rows of a table cannot be reached, 70 a bug of ours, 130 Ctrl-C.
    """
    # small matrices only: more threads would but get in each other's way
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic would look through all that is installed for plugins
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    with guarded_streams(), ending_at_interrupt():
        code = _run()
    sys.exit(code)


def _program(words: Sequence[str]) -> typer.Typer:
    """The program with the one command that is called: Typer makes all of those that it has."""
    called = words[0] if words else ""
    commands = [c for c in app.registered_commands if called in (c.name, _name(c.callback))]
    groups = [g for g in app.registered_groups if called == g.name]
    if not commands and not groups:
        return app
    alone = copy.copy(app)
    alone.registered_commands, alone.registered_groups = commands, groups
    return alone


def _name(callback: Callable[..., object] | None) -> str:
    return getattr(callback, "__name__", "")


def _run() -> int | str | None:
    """Run the command; its exit code."""
    code: int | str | None = 0
    try:
        try:
            _program(sys.argv[1:])()
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
            "Set ORTHOCAL_DEBUG=1 to see where, and report it."
        )
        code = 70
    return code


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True)
    ] = False,
) -> None:
    if version:
        put_out(orthocal.__version__)
        raise typer.Exit
