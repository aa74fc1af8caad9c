"""The direction of the indenter: its axis and rotation, and invalid directions."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.config import from_table
from meshskin.core.errors import ConfigError


def test_default_points_exactly_upwards():
    indenter = ms.Indenter()
    assert np.array_equal(indenter.axis, [0.0, 0.0, 1.0])
    assert np.array_equal(indenter.rotation, np.eye(3))
    assert np.array_equal(ms.Indenter(direction=(0.0, 0.0, 7.5)).rotation, np.eye(3))


@pytest.mark.parametrize(
    "direction",
    [
        (1.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.48, -0.64, 0.6), (0.0, 0.0, -1.0), (1e-9, 0.0, -1.0),
        (3e-9, -1e-9, 1.0), (1e-300, 2e-300, 0.0), (1e300, 0.0, -1e300),
    ],
)  # fmt: skip
def test_rotation_is_the_shortest_onto_the_direction(direction):
    indenter = ms.Indenter.sphere(0.01, direction=direction)
    large = np.array(direction) / np.abs(direction).max()
    along = large / np.linalg.norm(large)
    np.testing.assert_allclose(indenter.axis, along, atol=1e-15)
    rotation = indenter.rotation
    np.testing.assert_allclose(rotation[:, 2], along, atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.trace(rotation) == pytest.approx(1.0 + 2.0 * along[2])  # its angle is that of z to it


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        ([0, 0, 0], r"direction must not be zero, got \(0, 0, 0\); give the vector"),
        ([1, 0], r"direction must be a tuple of 3 numbers, got \(1, 0\)"),
        ([0, 0, 1, 0], "direction must be a tuple of 3 numbers"),
        (1, "direction must be a tuple of 3 numbers, got 1"),
        ([0, float("nan"), 1], "direction must be a finite number, got nan"),
        ([0, "z", 1], "direction must be a number, got 'z'"),
        ([[0, 0, 1]], "direction must be a tuple of 3 numbers"),
    ],
)
def test_invalid_directions_raise_an_error_of_one_line(direction, message):
    with pytest.raises(ConfigError, match=message) as caught:
        from_table(ms.Indenter, {"direction": direction}, "indenter")
    assert "\n" not in str(caught.value)


def test_position_of_two_numbers_raises():
    with pytest.raises(
        ConfigError, match=r"indenter.position must be a tuple of 3 numbers, got \(1, 0\)"
    ):
        from_table(ms.Indenter, {"position_m": [1, 0]}, "indenter")
