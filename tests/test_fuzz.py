"""Mutated files of all kinds raise errors of orthocal or none, within 5 s and 500 MiB."""

from __future__ import annotations

import json
import re
import shutil
import signal

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated
from fuzzing import KINDS, lay_out, run

from orthocal import load_calibration, load_robot
from orthocal.calibration.file import calibration_document
from orthocal.errors import CalibrationFileError
from orthocal.kinematics.loop_closure import nominal_closure

COUNT = 400


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    lay_out(folder)
    return folder


def test_mutated_files_are_refused_or_good(good):
    results = run(good, seed=2026, count=COUNT, jobs=1, thorough=0.1)
    assert results.bad == []
    assert sum(results.outcomes.values()) == COUNT
    for kind in KINDS:  # cases of each kind were tried
        assert results.outcomes[kind, "refused"] > COUNT // 40
        assert results.outcomes[kind, "loads"] > 0


FAILURES = {
    "IndexError": "raise IndexError('inside')",
    "slow": "import time\na = time.process_time()\nwhile time.process_time() < a + 0.6: pass",
    "large": "b'x' * (350 * 2**20)",
    "ended with -11": f"import os; os.kill(os.getpid(), {int(signal.SIGSEGV)})",
}
"""Outcomes of a function, and what it does."""

SEED_OF_ERRORS = 8727
"""A seed whose first cases are files of errors."""


def test_failures_of_workers_are_reported(good, tmp_path, monkeypatch):
    """Workers run a changed function of orthocal, which fails in another way in each case; a large
    worker is begun anew, and what follows a failure is not blamed for it."""
    calls = tmp_path / "calls"
    calls.touch()
    change = (
        "from pathlib import Path\n"
        "import orthocal.observation.simulate as module\n"
        f"calls, codes = Path({str(calls)!r}), {list(FAILURES.values())!r}\n"
        "def load_errors(*_):\n"
        "    done = calls.read_text()\n"
        "    calls.write_text(done + 'x')\n"
        "    exec(codes[len(done)])\n"
        "module.load_errors = load_errors\n"
    )
    (tmp_path / "sitecustomize.py").write_text(
        "import os\nif os.environ.get('ORTHOCAL_FUZZ_WORKER'):\n"
        + "".join(f"    {line}\n" for line in change.splitlines())
    )
    monkeypatch.setenv("ORTHOCAL_FUZZ_PATH", str(tmp_path))
    monkeypatch.setenv("ORTHOCAL_FUZZ_LONGEST", "0.5")
    count = len(FAILURES)
    results = run(good, seed=SEED_OF_ERRORS, count=count, jobs=1, thorough=0.0)
    assert [(index, kind) for index, kind, _ in results.bad] == [
        (i, "errors") for i in range(count)
    ]
    for outcome, (_, _, found) in zip(FAILURES, results.bad, strict=True):
        assert found.startswith(outcome)


# ---- failures that were found


def test_noise_whose_square_underflows_is_refused(tmp_path):
    """Quotients by a σ of 1e-308 overflow when they are squared (seed 10, case 27478)."""
    document = calibration_document(calibrated(EXPERIMENT_2))
    document["gauges"][0]["sigma"] = 1e-308
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationFileError, match=r"gauges\[0\]\.sigma: found '1e-308'"):
        load_calibration(tmp_path)


def test_machine_with_one_passive_joint(root, tmp_path):
    """The Jacobian has one column (seed 3, case 5973)."""
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    path = folder / "biglide.urdf"
    text = path.read_text()
    changed = re.sub(r'(name="y_pin" type=)"continuous"', r'\1"fixed"', text)
    assert changed != text
    path.write_text(changed)
    robot = load_robot(folder)
    assert robot.passive_index.size == 1
    passive = nominal_closure(robot).close(robot.drive_zero)
    assert passive == pytest.approx(np.zeros(1), abs=1e-9)
