"""A jump of the contacts: a place in the recording before which there are contacts."""

from types import SimpleNamespace

import numpy as np
from scipy import stats

from meshskin.estimation.joint.departures import normal_score
from meshskin.estimation.joint.jump import largest_jump


def fitted(count, begin):
    """Readings, one for each of `count` contacts, which those from `begin` on displace by 1 mm
    along x, under a standard deviation of 10 um, and the others by none."""
    moved = np.tile(np.eye(3), (count, 1)).reshape(count, 3, 3)[:, 0] * 1e5
    residual = np.where(np.arange(count) >= begin, 100.0, 0.0)
    return SimpleNamespace(
        data=SimpleNamespace(points=np.zeros((count, 3)), reach=lambda: np.ones(count)),
        rate=-residual,
        curvature=np.ones(count),
        readings=SimpleNamespace(contact=np.arange(count)),
        moved=lambda directions: moved,
        unexplained=lambda columns: (columns, columns),
        shared=lambda columns: (columns.T @ residual, columns.T @ columns),
    )


def test_a_displacement_of_part_of_the_contacts_is_found_where_it_begins():
    found = largest_jump(fitted(160, 80))
    assert found.part == 0.5
    np.testing.assert_allclose(found.shown, [1e-3, 0.0, 0.0], atol=1e-12)


def test_a_displacement_of_all_contacts_is_no_jump():
    """Of fewer contacts than places the first place was the first contact."""
    assert largest_jump(fitted(1, 0)).score == 0.0
    assert largest_jump(fitted(8, 0)).part > 0


def test_the_score_of_several_directions_is_that_of_one_as_improbable():
    """Beside the normal quantile of the chi-square distribution's tail."""
    assert normal_score(9.0, 1) == 3.0
    for square, count, off in ((4.0, 3, 0.01), (10.0, 3, 0.01), (20.0, 2, 0.04), (36.0, 3, 0.05)):
        exact = stats.norm.isf(stats.chi2.sf(square, count))
        assert abs(normal_score(square, count) - exact) < off * exact


def test_a_jump_is_estimated_at_the_place_that_is_given():
    found = largest_jump(fitted(160, 80), [120])
    assert found.part == 0.75
