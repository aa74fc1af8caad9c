"""Colors, ellipsoids and shapes that the live page draws."""

import numpy as np
import pytest

from meshskin.report.live import marks


def test_colors_are_those_of_the_scale_from_end_to_end():
    from matplotlib import colormaps

    low, high = np.array(marks.SIGMA_MM) * 1e-3
    sigma = [0.0, low / 2, low, np.sqrt(low * high), high, 2 * high]
    expected = colormaps["cividis"]([0.0, 0.0, 0.0, 0.5, 1.0, 1.0])[:, :3]
    np.testing.assert_allclose(marks.sigma_colors(sigma), 255 * expected, atol=1)


def test_what_is_not_determined_has_a_color_of_its_own():
    colors = marks.sigma_colors([np.nan, np.inf, 1e-4])
    assert colors[:2].tolist() == [list(marks.UNSEEN)] * 2
    assert colors[2].tolist() != list(marks.UNSEEN)


def test_linear_colors_are_the_inverse_of_srgb():
    light = marks.linear(np.arange(256)) / 255
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    # a step of 1 in 255 of the light is up to 13 steps of the darkest colors
    np.testing.assert_allclose(255 * encoded[60:], np.arange(60, 256), atol=2)
    assert marks.linear([0, 255]).tolist() == [0, 255]


def test_position_sigma_is_the_root_of_the_trace():
    covariances = np.stack([np.diag([9.0, 16.0, 0.0]), np.full((3, 3), np.nan)])
    assert marks.position_sigma(covariances).tolist() == [5.0, np.inf]


def test_ellipsoids_are_those_of_the_covariance_magnified():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(20, 3, 3)) * 1e-5
    covariances = root @ np.swapaxes(root, 1, 2) + 1e-10 * np.eye(3)
    axes, turns = marks.ellipsoids(covariances, magnified=30.0)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    drawn = turns @ (axes[:, :, None] ** 2 * np.swapaxes(turns, 1, 2))
    free = (axes > 1.01 * marks.MIN_AXIS).all(axis=1) & (axes < 0.99 * marks.MAX_AXIS).all(axis=1)
    assert free.sum() > 3
    np.testing.assert_allclose(drawn[free], 900 * covariances[free], rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    ("sigma", "axis"), [(1.0, marks.MAX_AXIS), (0.0, marks.MIN_AXIS), (np.nan, 0.0)]
)
def test_ellipsoids_keep_a_size_that_can_be_seen(sigma, axis):
    axes, _ = marks.ellipsoids(np.full((1, 3, 3), sigma**2) * np.eye(3))
    assert axes.tolist() == [[axis] * 3]


def test_the_tip_of_the_arrow_is_where_to_touch():
    vertices, _ = marks.arrow(0.02)
    assert abs(vertices[:, 2].min()) < 1e-12
    assert vertices[:, 2].max() == pytest.approx(0.02)
    np.testing.assert_allclose(vertices[np.argmin(vertices[:, 2])], 0.0, atol=1e-12)


def test_the_legend_names_its_unit_and_its_marks():
    with_truth, without = marks.legend(True), marks.legend(False)
    for words in ("(mm)", ">0.01<", ">0.1<", ">1<", ">10<", "not determined", "next touch"):
        assert words in without
    assert "true taxel" in with_truth
    assert "true taxel" not in without
