"""The normal equations of taxels, contacts and global parameters against dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.joint.coupled_system import CoupledSystem, CouplingPattern
from meshskin.estimation.joint.likelihood import Readings

TAXELS, CONTACTS, SIZE, SHARED = 7, 9, 4, 5


@pytest.fixture(scope="module")
def systems():
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
    jacobian = rng.standard_normal((SIZE + SHARED + 3, k))
    rate, curvature = rng.standard_normal(k), rng.random(k) + 0.5
    pattern = CouplingPattern(readings, CONTACTS)
    parts = CoupledSystem.from_readings(pattern, jacobian, rate, curvature, SIZE)
    parts = replace(
        parts,
        taxels=parts.taxels + np.eye(SIZE),
        contacts=parts.contacts + np.eye(3),
        shared=parts.shared + np.eye(SHARED),
    )
    first, second = TAXELS * SIZE, TAXELS * SIZE + CONTACTS * 3
    rows = np.zeros((k, second + SHARED))
    for r in range(k):
        rows[r, taxel[r] * SIZE : (taxel[r] + 1) * SIZE] = jacobian[:SIZE, r]
        rows[r, first + 3 * contact[r] : first + 3 * contact[r] + 3] = jacobian[-3:, r]
        rows[r, second:] = jacobian[SIZE:-3, r]
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
