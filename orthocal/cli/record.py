"""The command `record`: readings typed at the machine, one at a time."""

from __future__ import annotations

from pathlib import Path

import typer

from orthocal.cli.options import command
from orthocal.cli.printing import put_out
from orthocal.runtime.interrupts import INTERRUPTED


@command()
def record(session: Path) -> None:
    """Record readings one at a time, with warnings of mistakes.

    The positions of gauge and machine are printed for each reading. Every reading is on disk before
    the next one is asked for. An interrupted recording continues at the first missing reading.
    From a pipe each line counts as typed.

    A reading far from the one that the others predict is marked at once; about one correct reading
    in 400 is. The other warnings are those of `check` for the readings so far.

    Args:
        session (SESSION): session.yaml of a plan, or the directory that contains it. Its
            readings.csv has a line for each reading, which may be empty; a session.yaml without
            the key `readings` gets one.
    """
    from orthocal.cli.recording import Dialogue
    from orthocal.measurement.recording import open_recording

    interrupted = False
    with open_recording(session) as recording:
        dialogue = Dialogue(recording, str(session))
        try:
            dialogue.run()
        except KeyboardInterrupt:
            interrupted = True
            put_out("")
        dialogue.conclude()
    if interrupted:
        raise typer.Exit(INTERRUPTED)
