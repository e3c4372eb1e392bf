"""Mutated files of all kinds: orthocal's errors or none, in 5 s and 500 MB; see `fuzzing`.

What a longer run found stands below as tests of their own.
"""

from __future__ import annotations

import json
import re
import shutil
import signal

import numpy as np
import pytest
from fuzzing import KINDS, lay_out, make_case, run

from orthocal import calibrate, load_calibration, load_robot
from orthocal.calibration.file import calibration_document
from orthocal.errors import CalibrationFileError
from orthocal.kinematics.loop_closure import nominal_closure

COUNT = 800


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    lay_out(folder)
    return folder


def test_mutated_files_are_refused_or_good(good):
    found = run(good, seed=2026, count=COUNT, jobs=1, thorough=0.1)
    assert found.bad == []
    assert sum(found.outcomes.values()) == COUNT
    for kind in KINDS:  # else nothing was tried of it
        assert found.outcomes[kind, "refused"] > 20
        assert found.outcomes[kind, "loads"] > 0


def test_a_case_is_the_same_again(good):
    files = {kind: (good / file).read_bytes() for kind, file in KINDS.items()}
    assert [make_case(1, i, files)[:2] for i in range(50)] == [
        make_case(1, i, files)[:2] for i in range(50)
    ]


@pytest.mark.parametrize(
    ("spoil", "seen"),
    [
        ("raise IndexError('inside')", "IndexError"),
        (f"import os; os.kill(os.getpid(), {int(signal.SIGSEGV)})", "ended with -11"),
        ("b'x' * (450 * 2**20)", "large"),
        ("import time\na = time.process_time()\nwhile time.process_time() < a + 1.5: pass", "slow"),
    ],
)
def test_what_must_not_be_is_seen(spoil, seen, good, tmp_path, monkeypatch):
    """A watchdog that sees nothing is none: a module of ours is spoilt for the workers."""
    lines = "\n".join(f"    {line}" for line in spoil.splitlines())
    code = (
        "import orthocal.observation.simulate as module\n"
        f"def load_errors(*_):\n{lines}\n"
        "module.load_errors = load_errors\n"
    )
    (tmp_path / "sitecustomize.py").write_text(
        "import os\nif os.environ.get('ORTHOCAL_FUZZ_WORKER'):\n"
        + "".join(f"    {line}\n" for line in code.splitlines())
    )
    monkeypatch.setenv("ORTHOCAL_FUZZ_PATH", str(tmp_path))
    monkeypatch.setenv("ORTHOCAL_FUZZ_LONGEST", "1.0")
    files = {kind: (good / file).read_bytes() for kind, file in KINDS.items()}
    seed = next(s for s in range(100) if make_case(s, 0, files)[0] == "errors")
    found = run(good, seed=seed, count=1, jobs=1, thorough=0.0)
    assert [(index, kind) for index, kind, _ in found.bad] == [(0, "errors")]
    assert seen in found.bad[0][2]


# ---- finds


def test_a_noise_whose_square_is_no_number(experiment_2, tmp_path):
    """Quotients by a σ of 1e-308 overflow when they are squared: seed 10, case 27478."""
    document = calibration_document(calibrate(experiment_2))
    document["session"]["gauge_sigma"] = 1e-308
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationFileError, match=r"session.gauge_sigma: found '1e-308'"):
        load_calibration(tmp_path)


def test_a_machine_with_one_passive_joint(root, tmp_path):
    """Its Jacobian has one column, which is no vector: seed 3, case 5973."""
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    path = folder / "biglide.urdf"
    text = path.read_text()
    spoilt = re.sub(r'(name="y_pin" type=)"continuous"', r'\1"fixed"', text)
    assert spoilt != text
    path.write_text(spoilt)
    robot = load_robot(folder)
    assert robot.passive_index.size == 1
    passive = nominal_closure(robot).close(robot.drive_zero)
    assert passive == pytest.approx(np.zeros(1), abs=1e-9)
