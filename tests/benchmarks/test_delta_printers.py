"""A sample of the printers of `delta_printers.py`."""

from __future__ import annotations

import numpy as np
from delta_printers import examine, report

SAMPLE = 4


def test_a_sample_of_printers_keeps_its_promises(tmp_path, capsys):
    results = [examine(tmp_path, seed) for seed in range(SAMPLE)]
    assert report(results), capsys.readouterr().out
    before, theirs, ours = np.sqrt(np.mean([np.square(r.layer) for r in results], axis=0))
    assert ours < 1.05 * theirs
    assert ours < 0.05 * before
    expected = np.sqrt(np.mean([r.expected[0] ** 2 for r in results]))
    assert ours < 1.5 * expected  # four printers scatter by a fifth
    assert all(r.verdict == "enter" for r in results)
