"""The command `trace`."""

from __future__ import annotations

from typing import Annotated

from typer import Argument

import orthocal
from orthocal.cli.options import Force, OutDirectory, PlanPath, command, read_pairs
from orthocal.cli.overwriting import require_new_session
from orthocal.cli.printing import put_note

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
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.measurement.importing.traces import (
        FEWEST_SAMPLES,
        bin_traces,
        read_trace,
        with_traces,
    )
    from orthocal.session.points import count_readings

    require_new_session(out, FILES, force=force)
    plan = load_plan(session)
    files = read_pairs(traces, "traces", "SETUP=FILE")
    by_setup = {name: read_trace(path, plan.robot) for name, path in files.items()}
    binned = bin_traces(plan, by_setup)
    averaged = with_traces(plan, binned)
    path = orthocal.write_session(averaged, out)
    samples = sum(len(t.values) for t in by_setup.values())
    put_note(
        f"Wrote {path}: {counted(count_readings(averaged), 'reading')}, of which the traces of "
        f"{', '.join(by_setup)} are {samples} samples"
    )
    unused = sum(t.unused_bins for t in binned.values())
    if unused:
        in_bins = sum(t.unused_samples for t in binned.values())
        put_note(
            f"{unused} of {counted(unused + sum(len(t.values) for t in binned.values()), 'bin')} "
            f"({counted(in_bins, 'sample')}) {'was' if unused == 1 else 'were'} not used: a bin "
            f"needs {FEWEST_SAMPLES} samples at different positions"
        )
