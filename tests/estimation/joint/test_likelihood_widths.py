"""Optima that are flatter than their curvature says, under likelihoods in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.joint import likelihood_widths


def estimator_of(count, monkeypatch):
    """Taxels at the origin of the plane z = 0, in open sectors."""
    monkeypatch.setattr(likelihood_widths, "open_sectors", lambda *_: np.full(count, np.pi))
    frames = np.tile(np.eye(3), (count, 1, 1))
    return SimpleNamespace(
        state=SimpleNamespace(z=np.zeros((count, 2))),
        data=SimpleNamespace(
            reach=lambda: np.array([4e-3]),
            body=SimpleNamespace(closest=lambda points: SimpleNamespace(point=points)),
        ),
        problem=SimpleNamespace(
            points=lambda state: np.zeros((count, 3)),
            parametrization=SimpleNamespace(rotations=lambda: frames),
        ),
    )


def nowhere(estimator, rows, points):
    """Contacts that are far from each other."""
    return points, np.full(len(rows), np.inf)


def test_a_flat_optimum_is_as_wide_as_its_likelihood(monkeypatch):
    """Cost k (y^2 - a^2)^2 across the line y = 0 of the contacts, at y = a: sigma = (8 k a^2)^-1/2,
    and the mirror image at -a, six sigma away, fits as well. The second taxel is Gaussian."""
    sigma, axis = 0.1e-3, np.array([0.6, 0.8])
    a = 3 * sigma
    k = 1 / (8 * a**2 * sigma**2)

    def odds(first, second):
        y = (second.points - first.points)[:, :2] @ axis
        return np.where(first.rows == 0, k * ((a + y) ** 2 - a**2) ** 2, y**2 / (2 * sigma**2))

    monkeypatch.setattr(likelihood_widths, "log_odds_between", odds)
    monkeypatch.setattr(likelihood_widths, "_contact_centres", nowhere)
    across = np.array([-0.8, 0.6])
    narrow = sigma**2 * np.outer(axis, axis) + (sigma / 4) ** 2 * np.outer(across, across)
    flat, gaussian = likelihood_widths.widened(
        estimator_of(2, monkeypatch), np.stack([narrow, narrow]), 1.0
    )
    assert np.allclose(gaussian, narrow, rtol=1e-9)
    assert axis @ flat @ axis == pytest.approx((6 * sigma) ** 2)
    assert across @ flat @ across == pytest.approx((sigma / 4) ** 2)
    assert across @ flat @ axis == pytest.approx(0.0, abs=1e-15)


def test_widths_are_found_in_parts_of_six_places_a_taxel(monkeypatch):
    """An online calibration does one part a frame."""
    evaluated = []

    def odds(first, second):
        evaluated[-1] += len(first.rows)
        return np.sum((second.points - first.points) ** 2, axis=1) / (2 * 0.1e-3**2)

    monkeypatch.setattr(likelihood_widths, "log_odds_between", odds)
    covariance, rows = np.tile(0.1e-3**2 * np.eye(2), (3, 1, 1)), np.arange(3)
    evaluated.append(0)
    work = likelihood_widths.widened_along_axis(estimator_of(3, monkeypatch), rows, covariance, 1.0)
    for _ in work:
        evaluated.append(0)
    assert evaluated == [0] + [3 * 6] * 8


@pytest.mark.parametrize("bend", [-4.0, 0.0, 4.0, 12.0])
def test_a_flat_optimum_that_bends_is_as_wide_as_along_its_ridge(bend, monkeypatch):
    """Two optima six standard deviations apart, one 5 times (in cost 2) less likely, on a ridge
    that bends by `bend` standard deviations across on the way: beyond 3 a straight line leaves it.
    """
    sigma, breadth, less = 0.05e-3, 0.005e-3, 2.0

    def odds(first, second):
        x, y = (second.points - first.points)[:, :2].T / [[sigma], [breadth]]
        along = x**2 * (1 - x / 6) ** 2 / 2 + less * np.clip(x / 6, 0, None) ** 2
        return along + (y - bend * (x / 6) ** 2) ** 2 / 2

    monkeypatch.setattr(likelihood_widths, "log_odds_between", odds)
    monkeypatch.setattr(likelihood_widths, "_contact_centres", nowhere)
    narrow = np.diag([sigma, breadth])[None] ** 2
    found = likelihood_widths.widened(estimator_of(1, monkeypatch), narrow, 1.0)[0]
    other = np.array([6 * sigma, bend * breadth])
    assert np.sqrt(found[0, 0]) == pytest.approx(6 * sigma / np.sqrt(2 * less), rel=1e-6)
    assert other @ np.linalg.inv(found) @ other < 2 * 2 * less * (1 + 1e-6)
    assert np.sqrt(found[1, 1]) < max(1.0, abs(bend)) * breadth * (1 + 1e-6)


@pytest.mark.parametrize("around", [True, False])
def test_a_taxel_seen_from_one_place_is_as_wide_as_the_arc(around, monkeypatch):
    """The distance from contacts at nearly one place is known to 0.02 mm, the arc length to 1.5 mm,
    while the curvature says 0.3 mm: straight steps leave the arc at once."""
    radius, sigma, along = 3e-3, 0.02e-3, 1.5e-3
    centre = np.array([0.0, -radius, 0.0])

    def odds(first, second):
        off = second.points - centre
        angle = np.arctan2(off[:, 0], off[:, 1])
        distance = np.linalg.norm(off, axis=1)
        return ((distance - radius) / sigma) ** 2 / 2 + (radius * angle / along) ** 2 / 2

    def middle(estimator, rows, points):
        place = np.tile(centre, (len(rows), 1)), np.full(len(rows), 0.4e-3)
        return place if around else nowhere(estimator, rows, points)

    monkeypatch.setattr(likelihood_widths, "log_odds_between", odds)
    monkeypatch.setattr(likelihood_widths, "_contact_centres", middle)
    narrow = np.diag([0.3e-3, sigma])[None] ** 2
    found = likelihood_widths.widened(estimator_of(1, monkeypatch), narrow, 1.0)[0]
    wide = np.sqrt(found[0, 0])
    if around:
        assert 0.8 * along < wide < 1.1 * along
    else:
        assert wide < 0.8 * along
    sigmas = np.array([-2.0, -1.0, 1.0, 2.0])  # of places on the arc; along each axis no more
    turned = along / radius * sigmas[:, None]
    places = radius * np.hstack([np.sin(turned), np.cos(turned) - 1])
    far = np.sqrt(np.einsum("ki,ij,kj->k", places, np.linalg.inv(found), places))
    assert (far < np.sqrt(2) * np.abs(sigmas)).all() == around
