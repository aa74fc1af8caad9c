"""The variances of an estimate with a learned response."""

from types import SimpleNamespace

import numpy as np

from meshskin.estimation.joint.pressure import CENSORED, OBSERVED
from meshskin.estimation.learned.result import _few_readings, _own_misfit


def test_few_readings_of_a_taxel_widen_its_variance():
    """In Hertz worlds with 3 readings of a taxel 0.7 of the error was stated, with 9 readings
    0.95: silent ones do not count."""
    taxel = np.repeat([0, 1, 2], [3, 9, 100])
    kind = np.full(112, OBSERVED)
    kind[20:] = CENSORED
    effects = SimpleNamespace(
        readings=SimpleNamespace(taxel=taxel, kind=kind),
        unknowns=SimpleNamespace(nuisance=np.zeros((4, 2))),
    )
    factor = _few_readings(effects)
    assert 0.8 < 0.7 * factor[0] ** 0.5 < 1.25
    assert factor[1] < 1.1
    assert factor[3] > factor[0] > factor[2] > 1


def test_residuals_far_larger_than_those_of_most_widen_a_taxel():
    """By their own variance; twice that of most may be chance."""
    taxel, own = np.repeat(np.arange(5), 12), np.array([1.0, 1.0, 1.0, 2.0, 9.0])
    effects = SimpleNamespace(
        readings=SimpleNamespace(taxel=taxel, kind=np.full(60, OBSERVED)),
        unknowns=SimpleNamespace(nuisance=np.zeros((5, 2))),
        residuals=lambda: 0.7 * own[taxel] ** 0.5,
    )
    np.testing.assert_allclose(_own_misfit(effects), [1.0, 1.0, 1.0, 1.0, 9.0])
