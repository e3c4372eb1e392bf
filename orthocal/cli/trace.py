"""The command `trace`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.options import OutDirectory, command, read_pairs
from orthocal.cli.overwriting import require_new_session
from orthocal.cli.printing import put_note


@command()
def trace(plan: Path, traces: list[str], out: OutDirectory, force: bool = False) -> None:
    """Average traces of a gauge into readings of a session.

    A trace is read while the tool moves along a path. It is a CSV file with the columns x_mm,
    y_mm, z_mm (commanded position of the tool) and reading_mm, with thousands of lines. The
    directory receives session.yaml with a posture for each average, and readings.csv.

    Args:
        traces (SETUP=FILE ...): Setup and the CSV file of its trace.
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

    require_new_session(out, ("session.yaml", "readings.csv"), force=force)
    session = load_plan(plan)
    files = read_pairs(traces, "traces", "SETUP=FILE")
    by_setup = {name: read_trace(path, session.robot) for name, path in files.items()}
    binned = bin_traces(session, by_setup)
    averaged = with_traces(session, binned)
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
