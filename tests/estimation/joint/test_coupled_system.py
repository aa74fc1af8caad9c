"""The normal equations of taxels, contacts and global parameters against dense linear algebra."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.joint.coupled_system import CoupledSystem, CouplingPattern
from meshskin.estimation.joint.readings import Readings
from meshskin.estimation.learned.lagged_system import LaggedSystem

TAXELS, CONTACTS, SIZE, SHARED = 7, 9, 4, 5


@pytest.fixture(scope="module", params=["own contacts", "earlier contacts, too"])
def systems(request):
    """A system in parts, and the same as a dense matrix and gradient."""
    rng = np.random.default_rng(0)
    taxel, contact = np.nonzero(rng.random((TAXELS, CONTACTS)) < 0.6)
    readings = replace(
        Readings.none(),
        contact=contact,
        taxel=taxel,
        starts=np.searchsorted(taxel, np.arange(TAXELS + 1)),
    )
    k = len(taxel)
    jacobian = rng.standard_normal((k, SIZE + SHARED + 3))
    rate, curvature = rng.standard_normal(k), rng.random(k) + 0.5
    pattern = CouplingPattern(readings, CONTACTS)
    parts = CoupledSystem.from_readings(pattern, jacobian, rate, curvature, SIZE)
    lag, source = np.zeros((k, 3)), contact
    if request.param != "own contacts":
        lag = rng.standard_normal((k, 3)) * (rng.random((k, 1)) < 0.5)
        source = (contact + rng.integers(1, CONTACTS, k)) % CONTACTS
        parts = LaggedSystem.extended(parts, jacobian, rate, curvature, lag, source)
    parts = replace(
        parts,
        taxels=parts.taxels + np.eye(SIZE),
        contacts=parts.contacts + np.eye(3),
        shared=parts.shared + np.eye(SHARED),
    )
    first, second = TAXELS * SIZE, TAXELS * SIZE + CONTACTS * 3
    rows = np.zeros((k, second + SHARED))
    for r in range(k):
        rows[r, taxel[r] * SIZE : (taxel[r] + 1) * SIZE] = jacobian[r, :SIZE]
        rows[r, first + 3 * contact[r] : first + 3 * contact[r] + 3] = jacobian[r, -3:]
        rows[r, first + 3 * source[r] : first + 3 * source[r] + 3] += lag[r]
        rows[r, second:] = jacobian[r, SIZE:-3]
    dense = rows.T @ (curvature[:, None] * rows) + np.eye(second + SHARED)
    return parts, dense, rows.T @ rate, (first, second)


def test_gradient(systems):
    parts, _, gradient, _ = systems
    np.testing.assert_allclose(
        np.concatenate([g.ravel() for g in parts.gradient]), gradient, atol=1e-12
    )


def test_solution(systems):
    parts, dense, _, (first, second) = systems
    right = np.random.default_rng(1).standard_normal((len(dense), 2))
    split = right[:first].reshape(TAXELS, SIZE, 2), right[first:second].reshape(CONTACTS, 3, 2)
    x = parts.solve(*split, right[second:])
    found = np.concatenate([part.reshape(-1, 2) for part in x])
    np.testing.assert_allclose(found, np.linalg.solve(dense, right), atol=1e-12)


def test_what_a_solution_explains(systems):
    """b^T H^-1 b and b^T H^-1 g without the solution H^-1 b."""
    parts, dense, gradient, (first, second) = systems
    right = np.random.default_rng(2).standard_normal((len(dense), 3))
    split = right[:first].reshape(TAXELS, SIZE, 3), right[first:second].reshape(CONTACTS, 3, 3)
    square, along = parts.explained(*split, right[second:])
    np.testing.assert_allclose(square, right.T @ np.linalg.solve(dense, right), rtol=1e-10)
    np.testing.assert_allclose(along, right.T @ np.linalg.solve(dense, gradient), rtol=1e-9)


def test_covariances(systems):
    parts, dense, _, (_, second) = systems
    inverse = np.linalg.inv(dense)
    taxels, shared = parts.covariances()
    for k, block in enumerate(taxels):
        at = slice(k * SIZE, (k + 1) * SIZE)
        np.testing.assert_allclose(block, inverse[at, at], atol=1e-12)
    np.testing.assert_allclose(shared, inverse[second:, second:], atol=1e-12)


def test_damping_scales_the_diagonal_of_taxels_and_global_parameters(systems):
    parts = systems[0]
    damped = parts.damped(0.5)
    for name in ("taxels", "shared"):
        before, after = getattr(parts, name), getattr(damped, name)
        ratio = np.diagonal(after, axis1=-2, axis2=-1) / np.diagonal(before, axis1=-2, axis2=-1)
        np.testing.assert_allclose(ratio, 1.5)
    np.testing.assert_array_equal(damped.contacts, parts.contacts)


def test_other_unknowns_follow_the_global_parameters(systems):
    parts, dense, _, (first, second) = systems
    shared = np.random.default_rng(2).standard_normal(SHARED)
    taxels, contacts, kept = parts.following(shared)
    expected = -np.linalg.solve(dense[:second, :second], dense[:second, second:] @ shared)
    np.testing.assert_allclose(taxels.ravel(), expected[:first], atol=1e-12)
    np.testing.assert_allclose(contacts.ravel(), expected[first:], atol=1e-12)
    np.testing.assert_array_equal(kept, shared)


def test_a_restrained_step_minimizes_the_cost_with_the_restraint(systems):
    parts, dense, _, (_, second) = systems
    rng = np.random.default_rng(4)
    right, weight = rng.standard_normal(len(dense)), rng.random(SHARED)
    x = np.linalg.solve(dense, right)
    dense = dense.copy()
    dense[second:, second:] += np.diag(weight)
    expected = np.linalg.solve(dense, right)[second:]
    np.testing.assert_allclose(parts.restrained(x[second:], weight), expected, atol=1e-12)


def test_sums_without_a_compiler(systems):
    """The compiled sums and those by sparse matrices are the same."""
    compiled, rng = systems[0].pattern, np.random.default_rng(5)
    plain = copy(compiled)
    plain.library = None
    k = len(compiled.taxel)
    jacobian = rng.standard_normal((k, SIZE + SHARED + 3))
    coupling, values = rng.standard_normal((k, SIZE, 3)), rng.standard_normal((k, 2))
    inverse = rng.standard_normal((CONTACTS, 3, 3))
    inverse += np.swapaxes(inverse, 1, 2)
    x = [rng.standard_normal((n, 2)) for n in (TAXELS * SIZE, CONTACTS * 3, SHARED)]
    x = x[0].reshape(TAXELS, SIZE, 2), x[1].reshape(CONTACTS, 3, 2), x[2]
    for one, other in (
        [p.normal_equations(jacobian, values[:, 0], values[:, 1], SIZE) for p in (compiled, plain)],
        [p.eliminated(coupling, inverse) for p in (compiled, plain)],
        [p.transposed(jacobian, values, SIZE) for p in (compiled, plain)],
        [(p.forward(jacobian, x, SIZE), p.to_taxels(coupling, x[1])) for p in (compiled, plain)],
        [(p.to_contacts(coupling, x[0]),) for p in (compiled, plain)],
    ):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)


def test_products_with_the_derivatives(systems):
    """J^T v and J x agree with the matrix: x^T J^T v is the same either way."""
    parts, rng = systems[0], np.random.default_rng(6)
    k = len(parts.pattern.taxel)
    jacobian, v = rng.standard_normal((k, SIZE + SHARED + 3)), rng.standard_normal((k, 1))
    x = [rng.standard_normal((n, 1)) for n in (TAXELS * SIZE, CONTACTS * 3, SHARED)]
    x = x[0].reshape(TAXELS, SIZE, 1), x[1].reshape(CONTACTS, 3, 1), x[2]
    back = parts.transposed(jacobian, v)
    inner = sum(float(np.vdot(a, b)) for a, b in zip(x, back, strict=True))
    np.testing.assert_allclose(inner, float(np.vdot(parts.forward(jacobian, x), v)), rtol=1e-10)
