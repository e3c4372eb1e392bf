"""Errors come back from another process as they were raised there."""

from __future__ import annotations

import pickle

import pytest

from orthocal import errors

ERRORS = (
    errors.OrthocalError("found nothing", where="plan"),
    errors.ParameterError("found 1; expected 2", where="--setups"),
    errors.ClosureError("cannot be read", posture="x", residual=0.5),
    errors.NotIdentifiableError("nothing fixes a", parameters=("a",)),
    errors.SolverError("did not converge", status="no", iterations=3),
)


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
def test_an_error_is_the_same_elsewhere(error):
    found = pickle.loads(pickle.dumps(error))
    assert type(found) is type(error)
    assert str(found) == str(error)
    assert vars(found) == vars(error)
