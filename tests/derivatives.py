"""The one finite-difference checker of the tests."""

from __future__ import annotations

import numpy as np
from tolerances import DERIVATIVE


def central_differences(function, at, *, step=1e-6):
    """Derivative of a function of a vector, shape (*output, n)."""
    columns = []
    for i in range(at.size):
        e = np.zeros_like(at)
        e[i] = step
        columns.append((np.asarray(function(at + e)) - np.asarray(function(at - e))) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_derivative(
    exact,
    function,
    at,
    *,
    step=1e-6,
    tolerance=DERIVATIVE,
):
    """Compare an exact derivative with central differences, relative to the largest entry."""
    numeric = central_differences(function, at, step=step)
    assert np.all(np.isfinite(exact))
    scale = max(1.0, float(np.abs(numeric).max(initial=0.0)))
    assert np.abs(exact - numeric).max(initial=0.0) / scale < tolerance


def assert_program_derivatives(f, x, p, *, weight, directions, seed):
    """Compare gradient, Jacobian and Hessian of a nonlinear program with central differences.

    The directions and multipliers are drawn; `weight` is the objective's factor in the Lagrangian.
    """
    rng, zero = np.random.default_rng(seed), np.zeros(directions)
    along = rng.normal(size=(x.size, directions))
    along /= np.linalg.norm(along, axis=0)
    multipliers = rng.normal(size=f["nlp"].size1_out(1))

    def values(t):
        return np.concatenate([v.full().ravel() for v in f["nlp"](x + along @ t, p)])

    def gradients(t):
        gradient, jacobian = (f[k](x + along @ t, p)[1].full() for k in ("grad_f", "jac_g"))
        return np.vstack([gradient.reshape(1, -1), jacobian])

    numeric = central_differences(values, zero, step=1e-4)
    scale = np.maximum(1.0, np.abs(numeric).max(axis=1, keepdims=True))
    assert (np.abs(gradients(zero) @ along - numeric) / scale).max() < DERIVATIVE
    upper = f["hess_lag"](x, p, weight, multipliers).full()
    assert not np.tril(upper, -1).any()
    hessian = upper + np.triu(upper, 1).T
    weights = np.r_[weight, multipliers]
    assert_derivative(hessian @ along, lambda t: weights @ gradients(t), zero, step=1e-4)


def assert_jacobian(
    problem, theta, jacobian, *, columns=slice(None), step=1e-3, least=1e-9, tolerance=1e-6
) -> None:
    """Compare columns of a Jacobian by scaled parameters with central differences of the readings.

    Args:
        problem: Problem of an identification.
        theta: Parameters, shape (n_free,), [SI].
        jacobian: Shape (n_entries, n_free), [m].
        columns: Columns that are compared.
        step: Step in units of the parameters' scales.
        least: Smallest size of a column to which its error is compared, [m].
        tolerance: Largest relative error.
    """
    steps = step * np.diag(problem.theta_scale)[columns]
    ahead, behind = np.split(problem.predict(np.vstack([theta + steps, theta - steps])), 2)
    numeric = (ahead - behind).T / (2.0 * step)
    size = np.maximum(np.abs(numeric).max(axis=0), least)
    assert np.isfinite(jacobian).all()
    assert (np.abs(jacobian[:, columns] - numeric) / size).max() < tolerance
