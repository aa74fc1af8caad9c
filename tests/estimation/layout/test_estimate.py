"""The method "coactivation": the shape from co-activation, the place from the contact points."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.data.gather import gather
from meshskin.estimation.layout.alignment import aligned, root_mean_square
from meshskin.estimation.layout.estimate import touch_radius


@pytest.fixture(scope="module")
def found(noisy, noisy_recording):
    return ms.calibrate(noisy_recording, noisy.belief(), method="coactivation")


def test_taxels_are_within_half_a_pitch(noisy, found):
    error = found.positions - noisy.skin.positions
    assert np.isfinite(error).all()
    assert root_mean_square(error) < 1.3e-3
    assert np.mean(np.linalg.norm(error, axis=1) < 2 * found.position_sigma) > 0.9
    assert "rigid alignment" in found.anchor
    assert not any("contact points, weighted" in factor for factor in found.factors)


def test_moved_contact_points_move_the_whole_alone(noisy, noisy_recording, found):
    """The shape does not see where the contacts are: all of them are turned about the sphere."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    other = noisy_recording.with_columns(
        points=noisy_recording.points @ turn.T, normals=noisy_recording.normals @ turn.T
    )
    moved = ms.calibrate(other, noisy.belief(), method="coactivation")
    np.testing.assert_allclose(moved.positions, found.positions @ turn.T, atol=2e-5)


def test_the_scale_is_where_a_disc_answers(noisy, noisy_recording):
    """Between the patch's radius and that at which the disc leaves it."""
    data = gather(noisy_recording, noisy.belief())
    radius = float(np.median(data.radii))
    assert radius < touch_radius(data) < radius + data.disc


def test_raw_readings_have_no_scale(noisy, noisy_recording):
    with pytest.raises(CalibrationError, match="needs pressures"):
        ms.calibrate(
            noisy_recording, replace(noisy.belief(), readings="raw"), method="coactivation"
        )


def test_the_shape_agrees_with_that_of_the_layout(noisy, found):
    off = aligned(found.positions, noisy.skin.positions, mirror=False) - noisy.skin.positions
    assert root_mean_square(off) <= root_mean_square(found.positions - noisy.skin.positions)
