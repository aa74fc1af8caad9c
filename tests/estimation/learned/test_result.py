"""The variances of an estimate with a learned response."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.joint.pressure import CENSORED, OBSERVED
from meshskin.estimation.joint.small_effects import SmallEffects
from meshskin.estimation.learned import result
from meshskin.estimation.learned.result import LAGS, LOST_SHARE, SHARES, _few_readings, _own_misfit

from .test_estimate import RADIUS, belief, errors, hertz, recording, world


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


@pytest.mark.parametrize("leverage", [0.01, 0.5])
def test_lags_are_not_looked_for_where_contacts_have_errors_of_any_size(monkeypatch, leverage):
    """Counts with nominal forces and scattered contacts showed some that were none."""
    found = SmallEffects(8.0, np.ones((3, 2)), np.zeros((3, 2, 2)))
    for name in ("lags", "further_shares"):
        monkeypatch.setattr(result, name, lambda *_: found)
    monkeypatch.setattr(result, "lost_share", lambda _: replace(found, score=9.0))
    monkeypatch.setattr(result.small_effects, "contact_leverages", lambda _: np.array([leverage]))
    unknowns = SimpleNamespace(nuisance=np.zeros((3, 2)))
    data = SimpleNamespace(parameters=SimpleNamespace(columns={}))
    effects = SimpleNamespace(unknowns=unknowns, fitted=lambda: None, data=data)
    small = result._small_effects(effects, SimpleNamespace(good=True))
    clear = leverage < 0.1
    assert small[LAGS].score == (8.0 if clear else 0.0)
    assert small[LAGS].covariances.any() == clear
    assert not small[SHARES].displacements.any()
    assert small[LOST_SHARE].displacements.any() == clear  # the likeliest alone


@pytest.mark.deep
def test_lags_beside_an_estimated_friction_do_not_move_the_taxels():
    """Patches 0.3 mm behind the contacts along a spiral: lags moved the taxels by 0.1 mm."""
    points, *rest = world(hertz, seed=2)
    ahead = np.diff(points, axis=0, prepend=2 * points[:1] - points[1:2])
    points = points + 0.3e-3 * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    found = calibrate(recording(points, *rest), belief(contact="learned", readings="raw"))
    assert found.unknowns["friction"][0] == pytest.approx(0.3e-3, rel=0.1)
    assert "drag" not in found.unknowns
    assert errors(found)[0] < 0.03e-3
