"""The posterior's traces against dense linear algebra: exact, with unit vectors for probes."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.joint.coupled_system import CoupledSystem, CouplingPattern
from meshskin.estimation.joint.readings import Readings
from meshskin.estimation.learned.deviations import Posterior, Probes

TAXELS, CONTACTS, SHARED, PROFILE = 6, 8, 5, slice(2, 5)
SIZES = (TAXELS * 4, CONTACTS * 3, SHARED)
PRIOR = np.array([0.3, 0.3, 4.0, 0.5]), np.array([2.0, 2.0, 7.0]), np.array([1.0, 3, 5, 5, 5])


@pytest.fixture(scope="module")
def found():
    """The posterior by unit vectors, and W and the leverages by dense matrices."""
    rng = np.random.default_rng(3)
    taxel, contact = np.nonzero(rng.random((TAXELS, CONTACTS)) < 0.7)
    readings = replace(
        Readings.none(),
        contact=contact,
        taxel=taxel,
        starts=np.searchsorted(taxel, np.arange(TAXELS + 1)),
    )
    k = len(taxel)
    jacobian, curvature = rng.standard_normal((k, 4 + SHARED + 3)), rng.random(k) + 0.5
    system = CoupledSystem.from_readings(
        CouplingPattern(readings, CONTACTS), jacobian, np.zeros(k), curvature, 4
    )
    blocks = {
        name: getattr(system, name) + np.diag(prior)
        for name, prior in zip(("taxels", "contacts", "shared"), PRIOR, strict=True)
    }
    rows = np.zeros((k, sum(SIZES)))
    for r in range(k):
        rows[r, 4 * taxel[r] : 4 * taxel[r] + 4] = jacobian[r, :4]
        at = SIZES[0] + 3 * contact[r]
        rows[r, at : at + 3] = jacobian[r, -3:]
        rows[r, -SHARED:] = jacobian[r, 4:-3]
    precision = np.concatenate([np.tile(PRIOR[0], TAXELS), np.tile(PRIOR[1], CONTACTS), PRIOR[2]])
    covariance = np.linalg.inv(rows.T @ (curvature[:, None] * rows) + np.diag(precision))
    w = np.eye(len(precision)) - np.sqrt(precision)[:, None] * covariance * np.sqrt(precision)
    probes = Probes(readings, CONTACTS, 4)
    effects = np.eye(SIZES[0] + SIZES[1])
    effects[: SIZES[0]][np.arange(SIZES[0]) % 4 < 2] = 0.0
    probes.count = count = len(effects)
    probes.taxels = np.sqrt(count) * effects[: SIZES[0]].reshape(TAXELS, 4, count)
    probes.contacts = np.sqrt(count) * effects[SIZES[0] :].reshape(CONTACTS, 3, count)
    probes.readings = np.sqrt(count) * np.eye(k, count)
    names = ("gain", "offset")
    posterior = Posterior.of(
        replace(system, **blocks), jacobian, np.sqrt(curvature), PRIOR, probes, PROFILE, names
    )
    leverages = curvature * np.einsum("ki,ij,kj->k", rows, covariance, rows)
    return posterior, w, leverages


def test_determined_effects_are_traces(found):
    posterior, w, _ = found
    own, at = np.diag(w)[: SIZES[0]].reshape(-1, 4), np.diag(w)[SIZES[0] : -SHARED].reshape(-1, 3)
    expected = {
        "position": at[:, :2].sum(),
        "force": at[:, 2].sum(),
        "profile": np.diag(w)[-SHARED:][PROFILE].sum(),
        "gain": own[:, 2].sum(),
        "offset": own[:, 3].sum(),
    }
    assert posterior.determined == pytest.approx(expected)


def test_information_bounds_fisher_s_from_above(found):
    posterior, w, _ = found
    index = np.arange(len(w))
    kinds = {
        "gain": index[: SIZES[0]][2::4],
        "offset": index[: SIZES[0]][3::4],
        "force": index[SIZES[0] : -SHARED][2::3],
        "position": np.concatenate([index[SIZES[0] : -SHARED][k::3] for k in (0, 1)]),
    }
    every = np.concatenate(list(kinds.values()))
    for name, rows in kinds.items():
        row = np.sum(w[np.ix_(rows, every)] ** 2)
        assert posterior.information[name] == pytest.approx(row)
        assert row > np.sum(w[np.ix_(rows, rows)] ** 2)
    profile = w[-SHARED:, -SHARED:][PROFILE, PROFILE]
    assert posterior.information["profile"] == pytest.approx(np.sum(profile * profile.T))


def test_leverages(found):
    posterior, _, leverages = found
    count = min(len(leverages), SIZES[0] + SIZES[1])
    np.testing.assert_allclose(posterior.leverages[:count], leverages[:count], atol=1e-12)


def test_probes_are_of_effects_that_are_read():
    taxel, contact = np.array([0, 0, 2]), np.array([1, 3, 3])
    readings = replace(Readings.none(), taxel=taxel, contact=contact, starts=np.array([0, 2, 2, 3]))
    probes = Probes(readings, 4, 4)
    assert probes.seen.tolist() == [True, False, True]
    assert probes.touched.tolist() == [False, True, False, True]
    np.testing.assert_array_equal(
        np.abs(probes.taxels).max(axis=2), [[0, 0, 1, 1], [0] * 4, [0, 0, 1, 1]]
    )
    np.testing.assert_array_equal(np.abs(probes.contacts).max(axis=(1, 2)), [0, 1, 0, 1])
