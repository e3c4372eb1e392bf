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


def test_messages_are_limited_with_their_places():
    found = errors.OrthocalError("a" + 5000 * "x" + "b", where="file" + 3000 * "w" + ":3")
    assert found.where.startswith("filew")
    assert found.where.endswith("w:3")
    assert str(found) == f"{found.where}: {found.problem}"
    assert (found.problem[0], found.problem[-1]) == ("a", "b")
    whole = errors.OrthocalError(errors.LONGEST_MESSAGE * "x")
    assert whole.problem == errors.LONGEST_MESSAGE * "x"
    for error in (
        found,
        errors.OrthocalError(5000 * "x"),
        errors.ClosureError(5000 * "x", posture="p"),
    ):
        assert len(str(error)) <= errors.LONGEST_MESSAGE
        assert str(error).count("…") <= 2


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
def test_an_error_is_the_same_elsewhere(error):
    found = pickle.loads(pickle.dumps(error))
    assert type(found) is type(error)
    assert str(found) == str(error)
    assert vars(found) == vars(error)
