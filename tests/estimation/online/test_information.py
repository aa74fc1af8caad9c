"""Information of readings that come one after the other, against one dense solution."""

from types import SimpleNamespace

import numpy as np

from meshskin.estimation.chart import Charts
from meshskin.estimation.online.information import TaxelInformation

N, K = 3, 40
PRIOR = np.array([0.3, 2.0])
"""Standard deviations of ln gain and offset."""
SHARED = np.array([0.5, 0.1])


def test_readings_in_parts_are_those_at_once():
    rng = np.random.default_rng(0)
    names = ("gain", "offset")
    parameters = SimpleNamespace(
        nuisance_names=names, nuisance_sigma=PRIOR, sigma=SHARED, start=lambda: np.zeros(2)
    )
    owner = np.arange(K) % N
    jacobian, precision = rng.normal(size=(K, 6)), rng.uniform(0.5, 2.0, K)
    level = rng.normal(size=K)

    # all unknowns at once: those of each taxel (4), then the global ones (2)
    dense = np.zeros((K, 4 * N + 2))
    for k, taxel in enumerate(owner):
        dense[k, 4 * taxel : 4 * taxel + 4], dense[k, -2:] = jacobian[k, :4], jacobian[k, 4:]
    weight = np.concatenate([np.tile([0.0, 0.0, *PRIOR**-2.0], N), SHARED**-2.0])
    inverse = np.linalg.inv(dense.T @ (precision[:, None] * dense) + np.diag(weight))
    expected = inverse @ dense.T @ (precision * level)

    information = TaxelInformation(N, parameters, unit=1.0)
    first, rest = np.arange(20), np.split(np.arange(20, K), 4)
    hessian = np.zeros((N, 6, 6))
    gradient = np.zeros((N, 6))
    for k in first:
        hessian[owner[k]] += precision[k] * np.outer(jacobian[k], jacobian[k])
        gradient[owner[k]] -= precision[k] * level[k] * jacobian[k]
    hessian[:, 2:4, 2:4] += np.diag(PRIOR**-2.0)
    charts = Charts(*(np.zeros((N, *s)) for s in ((3,), (3,), (3, 2), (2, 2), ())))
    information.counted[:] = True
    information.put(np.arange(N), charts, np.zeros((N, 2)), gradient, hessian)
    for part in rest:
        information.solve()
        own, s = information.step[owner[part]], information.s
        mean = np.einsum("ki,ki->k", jacobian[part, :4], own) + jacobian[part, 4:] @ s
        rate = precision[part] * (mean - level[part])
        information.add(owner[part], jacobian[part], rate, precision[part])
    information.solve()

    np.testing.assert_allclose(information.step.ravel(), expected[:-2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(information.s, expected[-2:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(information.s_covariance, inverse[-2:, -2:], rtol=1e-9)
    joint = information.joint_covariance(np.arange(N))
    for taxel in range(N):
        rows = np.r_[4 * taxel : 4 * taxel + 4, 4 * N : 4 * N + 2]
        np.testing.assert_allclose(joint[taxel], inverse[np.ix_(rows, rows)], rtol=1e-9, atol=1e-12)
