"""Mutated files of all kinds raise errors of orthocal or none, within 5 s and 500 MiB.

The cases are those of `fuzzing`. Failures that a longer run found have tests of their own.
"""

from __future__ import annotations

import json
import re
import shutil
import signal

import numpy as np
import pytest
from calibrated import EXPERIMENT_2, calibrated
from fuzzing import KINDS, lay_out, make_case, run

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


def test_case_is_determined_by_seed_and_number(good):
    files = {kind: (good / file).read_bytes() for kind, file in KINDS.items()}
    assert [make_case(1, i, files)[:2] for i in range(50)] == [
        make_case(1, i, files)[:2] for i in range(50)
    ]


@pytest.mark.parametrize(
    ("code", "outcome"),
    [
        ("raise IndexError('inside')", "IndexError"),
        (f"import os; os.kill(os.getpid(), {int(signal.SIGSEGV)})", "ended with -11"),
        ("b'x' * (350 * 2**20)", "large"),
        ("import time\na = time.process_time()\nwhile time.process_time() < a + 0.6: pass", "slow"),
    ],
)
def test_failure_of_a_worker_is_reported(code, outcome, good, tmp_path, monkeypatch):
    """Workers run a changed function of orthocal."""
    lines = "\n".join(f"    {line}" for line in code.splitlines())
    change = (
        "import orthocal.observation.simulate as module\n"
        f"def load_errors(*_):\n{lines}\n"
        "module.load_errors = load_errors\n"
    )
    (tmp_path / "sitecustomize.py").write_text(
        "import os\nif os.environ.get('ORTHOCAL_FUZZ_WORKER'):\n"
        + "".join(f"    {line}\n" for line in change.splitlines())
    )
    monkeypatch.setenv("ORTHOCAL_FUZZ_PATH", str(tmp_path))
    monkeypatch.setenv("ORTHOCAL_FUZZ_LONGEST", "0.5")
    files = {kind: (good / file).read_bytes() for kind, file in KINDS.items()}
    seed = next(s for s in range(100) if make_case(s, 0, files)[0] == "errors")
    results = run(good, seed=seed, count=1, jobs=1, thorough=0.0)
    assert [(index, kind) for index, kind, _ in results.bad] == [(0, "errors")]
    assert outcome in results.bad[0][2]


# ---- failures that were found


def test_noise_whose_square_underflows_is_refused(tmp_path):
    """Quotients by a σ of 1e-308 overflow when they are squared (seed 10, case 27478)."""
    document = calibration_document(calibrated(EXPERIMENT_2))
    document["session"]["gauge_sigma"] = 1e-308
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationFileError, match=r"session.gauge_sigma: found '1e-308'"):
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
