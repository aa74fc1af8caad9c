"""Errors that readings of neighbouring contacts share, on linear readings of known errors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.joint.departures import MIN_SCORE
from meshskin.estimation.joint.pressure import OBSERVED
from meshskin.estimation.joint.residual_correlations import shared_errors

SPACING, WIDTH, NOISE = 5e-3, 4e-3, 0.01
"""Of the taxels, m, of the bell that they read, m, and of the noise, relative to its peak."""


def fitted(rng, errors=lambda contact, place: 0.0, noise=NOISE):
    """Readings of 64 taxels on a plane, crossed by lanes of contacts, with independent and shared
    errors, at the least-squares estimate of places and offsets; and the errors (64, 2), m, of it.

    errors: of the contacts (q,) at the places (q, 2), m, relative to a taxel.
    """
    grid = SPACING * np.arange(8)
    taxels = np.array([[x, y, 0.0] for x in grid for y in grid])
    along = np.arange(-2 * SPACING, 9 * SPACING, 1.5e-3)
    points = np.array([[x, y, 0.0] for y in along for x in along])
    taxel, contact = np.nonzero(np.linalg.norm(taxels[:, None] - points, axis=2) < 2 * WIDTH)
    place = points[contact] - taxels[taxel]
    bell = np.exp(-np.sum(place**2, axis=1) / (2 * WIDTH**2))
    own = np.stack([bell * place[:, 0], bell * place[:, 1], WIDTH**2 * np.ones(len(bell))])
    own /= WIDTH**2 * NOISE
    wrong, off, residual = (
        np.zeros((64, 2)),
        np.zeros(len(taxel)),
        noise * rng.normal(size=own[0].shape),
    )
    for k in range(64):
        rows = np.flatnonzero(taxel == k)
        off[rows] = errors(contact[rows], place[rows, :2])
        r = residual[rows] = (residual[rows] + off[rows]) / NOISE
        x = np.linalg.lstsq(own[:, rows].T, r, rcond=None)[0]
        wrong[k], residual[rows] = x[:2], r - own[:, rows].T @ x
    tangents = np.tile(np.eye(3)[:, :2], (64, 1, 1))
    readings = SimpleNamespace(
        contact=contact, taxel=taxel, kind=np.full(len(taxel), OBSERVED),
        precision=np.ones(len(taxel)),
        weight=np.ones(len(taxel)), starts=np.searchsorted(taxel, np.arange(65)),
    )  # fmt: skip
    data = SimpleNamespace(
        points=points, reach=lambda: np.full(len(points), 2 * WIDTH),
        sigma=1.0, threshold=-np.inf, saturation=np.inf,
    )  # fmt: skip
    found = SimpleNamespace(
        data=data, readings=readings, points=taxels, tangents=tangents, own=own,
        mu=np.zeros(len(taxel)), rate=-residual, curvature=np.ones(len(taxel)), prior=np.zeros(3),
    )  # fmt: skip
    return found, wrong


def wandering(rng):
    """Offsets of random walks over 1,000 contacts."""
    return lambda contact, place: 0.1 * NOISE * np.cumsum(rng.normal(size=2000))[contact]


def process(rng, mirrored):
    """Smooth functions of the place, odd (-1) or even (1) in it."""

    def errors(contact, place):
        waves, phase = rng.normal(size=(2, 40)) / (0.5 * 2 * WIDTH), rng.uniform(0, 6.28, 40)
        both = [np.cos(sign * place @ waves + phase).sum(axis=1) / 20**0.5 for sign in (1, -1)]
        return 3 * NOISE * (both[0] + mirrored * both[1]) / 2

    return errors


@pytest.mark.deep
def test_independent_errors_have_no_score():
    scores = [shared_errors(fitted(np.random.default_rng(k))[0]).score for k in range(8)]
    assert np.abs(np.mean(scores)) < 1.5  # the largest of six
    assert max(scores) < 4.5
    assert (
        not shared_errors(fitted(np.random.default_rng(0))[0])
        .covariances(fitted(np.random.default_rng(0))[0])
        .any()
    )


def test_the_score_does_not_depend_on_the_scale_of_the_noise():
    one, ten = (
        shared_errors(fitted(np.random.default_rng(1), noise=scale * NOISE)[0]).score
        for scale in (1.0, 10.0)
    )
    assert one == pytest.approx(ten, abs=1e-6)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("kind", "where"),
    [("time", "in time"), pytest.param("odd", "in place", marks=pytest.mark.slow)],
)
def test_the_covariances_hold_the_errors(kind, where):
    square, stated = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found, wrong = fitted(rng, wandering(rng) if kind == "time" else process(rng, -1))
        shared = shared_errors(found)
        assert shared.score > MIN_SCORE
        assert shared.where == where
        added = shared.covariances(found)
        independent = [
            np.linalg.inv(found.own[:, rows] @ found.own[:, rows].T)[:2, :2]
            for rows in (np.flatnonzero(found.readings.taxel == k) for k in range(64))
        ]
        square.append(np.mean(wrong**2))
        stated.append(np.mean(np.trace(added + independent, axis1=1, axis2=2)) / 2)
        assert np.mean(wrong**2) > 1.5 * np.mean(np.trace(independent, axis1=1, axis2=2)) / 2
    assert np.mean(stated) / np.mean(square) == pytest.approx(1.0, abs=0.3)


def test_small_errors_are_held_by_the_covariances():
    rng = np.random.default_rng(0)
    found, _ = fitted(rng, wandering(rng))
    shared, unit = shared_errors(found), np.tile(np.eye(2), (64, 1, 1))
    assert shared.beyond(unit, unit) == shared.departure
    few = replace(shared, score=7.0)
    assert few.beyond(0.1 * unit, unit) == {}
    assert few.beyond(unit, unit) == few.departure
    assert replace(shared, score=12.0).beyond(0.1 * unit, unit)


@pytest.mark.slow
def test_errors_that_are_even_in_the_place_displace_nothing():
    rng = np.random.default_rng(0)
    found, _ = fitted(rng, process(rng, 1))
    odd, _ = fitted(rng, process(rng, -1))
    even = shared_errors(found)
    assert even.score > MIN_SCORE
    added = np.trace(even.covariances(found), axis1=1, axis2=2).mean()
    assert added < 0.1 * np.trace(shared_errors(odd).covariances(odd), axis1=1, axis2=2).mean()
