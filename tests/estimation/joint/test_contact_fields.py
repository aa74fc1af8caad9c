"""Fields of displacements of the contact points, on linear readings and in a whole estimate."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.joint.departures import MIN_SCORE, FittedReadings
from meshskin.estimation.joint.residual_correlations import LEAST_SCORE, contact_fields

from ..learned.test_estimate import RADIUS, belief, errors, recording, world

SPACING, WIDTH, NOISE = 5e-3, 4e-3, 0.01
"""Of the taxels, m, of the bell that they read, m, and of the noise, relative to its peak."""


def fitted(rng, moved):
    """Readings of 64 taxels on a plane in contacts whose recorded points are `moved` (m, 3) -> (m,
    2), m, at the least-squares estimate of the places; and the errors (64, 2), m, of it."""
    grid = SPACING * np.arange(8)
    taxels = np.array([[x, y, 0.0] for x in grid for y in grid])
    along = np.arange(-2 * SPACING, 9 * SPACING, 1.5e-3)
    points = np.array([[x, y, 0.0] for y in along for x in along])
    taxel, contact = np.nonzero(np.linalg.norm(taxels[:, None] - points, axis=2) < 2 * WIDTH)
    place = (points[contact] - taxels[taxel])[:, :2]
    bell = np.exp(-np.sum(place**2, axis=1) / (2 * WIDTH**2)) / NOISE
    own = (bell[:, None] * place / WIDTH**2).T
    residual = rng.normal(size=len(taxel)) + np.sum(own.T * moved(points)[contact], axis=1)
    wrong = np.zeros((64, 2))
    for k in range(64):
        rows = np.flatnonzero(taxel == k)
        wrong[k] = np.linalg.lstsq(own[:, rows].T, residual[rows], rcond=None)[0]
        residual[rows] -= own[:, rows].T @ wrong[k]
    found = FittedReadings(
        data=SimpleNamespace(points=points, reach=lambda: np.full(len(points), 2 * WIDTH)),
        readings=SimpleNamespace(contact=contact, taxel=taxel),
        points=taxels, mu=np.zeros(len(taxel)), offset=np.zeros(len(taxel)), rate=-residual,
        curvature=np.ones(len(taxel)), own=own, prior=np.zeros(2),
        tangents=np.tile(np.eye(3)[:, :2], (64, 1, 1)),
    )  # fmt: skip
    return found, wrong


def waves(rng, length, deviation):
    """A smooth field of displacements, by cosines of wave numbers that are not the estimate's."""
    numbers, phase = rng.normal(size=(2, 2, 300)) / length, rng.uniform(0, 2 * np.pi, (2, 300))

    def moved(points):
        along = np.einsum("mi,ciw->mcw", points[:, :2], numbers) + phase
        return deviation * np.sqrt(2 / 300) * np.cos(along).sum(axis=2)

    return moved


@pytest.mark.slow
def test_noise_and_displacements_of_single_contacts_are_no_field():
    scores = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scores.append(contact_fields(fitted(rng, lambda points: np.zeros((len(points), 2)))[0]))
    assert max(found.score for found in scores) < LEAST_SCORE
    assert np.mean([found.score > 2 for found in scores]) < 0.25
    assert not any(found.covariances.any() for found in scores)


@pytest.mark.parametrize(
    ("length", "deviation"), [(6e-3, 0.03e-3), pytest.param(14e-3, 0.1e-3, marks=pytest.mark.slow)]
)
def test_a_field_has_its_size_and_what_it_displaces(length, deviation):
    square, stated = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        readings, wrong = fitted(rng, waves(rng, length, deviation))
        found = contact_fields(readings)
        assert found.score > MIN_SCORE
        assert 0.5 < found.deviation / deviation < 2.0
        square.append(np.mean(np.sum(wrong**2, axis=1)))
        stated.append(np.mean(np.trace(found.covariances, axis1=1, axis2=2)))
    assert np.sqrt(np.mean(stated) / np.mean(square)) == pytest.approx(1.0, abs=0.35)


def test_a_displacement_of_all_contacts_alike_does_not_show():
    """The taxels follow it: nothing tells, and nothing is stated."""
    rng = np.random.default_rng(0)
    readings, wrong = fitted(rng, lambda points: np.full((len(points), 2), 1e-3))
    assert np.abs(np.mean(wrong, axis=0) - 1e-3).max() < 1e-5
    assert contact_fields(readings).score < LEAST_SCORE


@pytest.mark.parametrize("alike", [pytest.param(False, marks=pytest.mark.deep), True])
def test_contact_points_that_are_alike_wrong_are_a_named_doubt(alike):
    """Points 0.06 mm off along the meridians, by waves of 45 mm: the taxels are, too."""
    points, *rest = world()
    height = np.cross([0.0, 1.0, 0.0], points)
    height /= np.linalg.norm(height, axis=1, keepdims=True)
    off = 0.085e-3 * np.sin(points @ np.array([140.0, 60.0, 0.0]))[:, None] * height
    moved = points + off
    moved *= RADIUS / np.linalg.norm(moved, axis=1, keepdims=True)
    found = calibrate(recording(moved if alike else points, *rest), belief())
    error, stated = errors(found)
    assert found.verdict.level == ("DOUBT" if alike else "PASS")
    assert 0.7 < stated / error < 2.0  # one wave is no random field
    assert any("alike within" in words for words in found.verdict.reasons) == alike
