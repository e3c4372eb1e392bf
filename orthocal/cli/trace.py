"""The command `trace`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument

import orthocal
from orthocal.cli.options import Force, OutDirectory, PlanPath, command
from orthocal.cli.overwriting import require_new_session
from orthocal.cli.printing import put_note
from orthocal.errors import SessionError
from orthocal.text import shorten

FILES = ("session.yaml", "readings.csv")

Traces = Annotated[
    list[str],
    Argument(metavar="SETUP=FILE ...", help="Setup and the CSV file of its trace."),
]


@command()
def trace(session: PlanPath, traces: Traces, out: OutDirectory, force: Force = False) -> None:
    """Average traces of a gauge into readings of a session.

    A trace is read while the tool moves along a path. It is a CSV file with the columns x_mm,
    y_mm, z_mm (commanded position of the tool) and reading_mm, with thousands of lines. The
    directory receives session.yaml with a posture for each average, and readings.csv.
    """
    from orthocal.assessment.wording import counted
    from orthocal.measurement.files.session_file import load_rows
    from orthocal.measurement.importing.traces import read_trace, with_traces

    require_new_session(out, FILES, force=force)
    plan = load_rows(session)
    files = _split(traces)
    by_setup = {name: read_trace(path, plan.robot) for name, path in files.items()}
    averaged = with_traces(plan, by_setup)
    path = orthocal.write_session(averaged, out)
    samples = sum(len(t.values) for t in by_setup.values())
    put_note(
        f"Wrote {path}: {counted(len(averaged.readings), 'reading')}, of which the traces of "
        f"{', '.join(by_setup)} are {samples} samples"
    )


def _split(traces: list[str]) -> dict[str, Path]:
    """Files by setup, from texts of the form SETUP=FILE."""
    files: dict[str, Path] = {}
    for text in traces:
        setup, _, file = text.partition("=")
        if not (setup and file):
            raise SessionError(f"found '{shorten(text)}'; expected SETUP=FILE", where="traces")
        if setup in files:
            raise SessionError(f"has two traces: '{setup}'", where="traces")
        files[setup] = Path(file)
    return files
