"""Adaptive exploration: targets, reasons for unmet ones, contacts by the arm."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError
from meshskin.effects.broken_taxels import BrokenTaxels
from meshskin.effects.encoder import Encoder
from meshskin.effects.friction import Friction
from meshskin.effects.gravity_error import GravityError
from meshskin.effects.sampling import Sampling
from meshskin.effects.scan_order import ScanOrder
from meshskin.effects.temperature_drift import TemperatureDrift
from meshskin.estimation.adaptive import BUDGET_USED, NEVER_READ, adapt
from meshskin.geometry.region import Cap
from meshskin.robot import collision
from meshskin.simulation.contact_samplers import (
    closed_loop_sampler,
    concatenate,
    settled_contacts,
    static_sampler,
)

TARGET = 45e-6


@pytest.fixture(scope="module")
def scene():
    """A small skin on the ellipsoid."""
    whole = ms.Scene.load("ellipsoid")
    skin = ms.Skin.cover(whole.body, count=19, spacing=5e-3, region=Cap((0.0, -1.0, 0.0)))
    return whole.with_(skin=skin, loop=replace(whole.loop, compile="never"))


def errors(found, scene):
    return np.linalg.norm(found.calibration.positions - scene.skin.positions, axis=1)


@pytest.mark.deep
def test_every_taxel_comes_below_the_target_in_few_contacts(scene):
    found = adapt(scene, TARGET, seed=3)
    assert found.unmet == {}
    assert found.calibration.position_sigma.max() <= TARGET
    assert errors(found, scene).max() < 4 * TARGET
    counts = [one.contacts for one in found.rounds]
    assert counts == sorted(counts)
    assert counts[-1] == len(found.recording.time) < 120
    assert found.rounds[-1].above == 0 < found.rounds[0].above
    # the same number of contacts thrown evenly over the skin leaves some taxel above it
    hit = scene.body.closest(found.recording.points)
    rng = np.random.default_rng(0)
    spread = scene.skin.positions[rng.integers(0, 19, counts[-1])]
    blind = spread + rng.uniform(-4e-3, 4e-3, spread.shape)
    other = ms.calibrate(ms.press(scene, scene.body.closest(blind).point, seed=3), scene.belief())
    assert other.position_sigma.max() > 1.1 * found.calibration.position_sigma.max()
    assert np.abs(hit.distance).max() < 1e-9


@pytest.mark.slow
def test_a_tighter_target_takes_more_contacts(scene):
    loose, tight = (adapt(scene, target, seed=1) for target in (2 * TARGET, TARGET))
    assert len(loose.recording.time) < len(tight.recording.time)


@pytest.mark.slow
def test_a_spent_budget_is_named(scene):
    short = adapt(scene, TARGET / 10, seed=2, most=60)
    assert len(short.recording.time) <= 60
    assert set(short.unmet.values()) == {BUDGET_USED}


@pytest.mark.slow
def test_a_dead_taxel_is_named(scene):
    dead = scene.with_(effects=(*scene.effects, BrokenTaxels(dead=0.06, stuck=0.0)))
    found = adapt(dead, 2 * TARGET, seed=2)
    assert list(found.unmet.values()) == [NEVER_READ]
    lost = found.calibration.ids == next(iter(found.unmet))
    assert not found.calibration.touched[lost].any()
    assert found.calibration.position_sigma[~lost].max() <= 2 * TARGET


@pytest.mark.deep
def test_gaps_that_nothing_reaches_leave_their_taxels_unread(scene):
    """The first pass touches a part of the skin; the arm reaches nothing of the rest."""
    near = np.argsort(np.linalg.norm(scene.skin.positions - scene.skin.positions[0], axis=1))
    first = scene.skin.positions[near[:6]]

    def touch(scene, seed):
        sample, calls = static_sampler(scene, seed), []

        def once(points):
            calls.append(points)
            if len(calls) > 1:
                raise ReachError("nothing is reached")
            return sample(points)

        return once

    found = adapt(scene, TARGET, seed=3, points=first, touch=touch)
    assert len(found.recording.time) == 6
    assert NEVER_READ in found.unmet.values()


def test_invalid_arguments(scene):
    with pytest.raises(ConfigError, match="target"):
        adapt(scene, 0.0)
    with pytest.raises(ConfigError, match=r"got 30 m, limit: above 0, below the 0.006"):
        adapt(scene, 30)
    with pytest.raises(ConfigError, match=r"first pass .* most=5; allow more"):
        adapt(scene, TARGET, most=5)
    with pytest.raises(ConfigError, match="the first pass needs a contact"):
        adapt(scene, TARGET, points=np.zeros((0, 3)))
    with pytest.raises(ConfigError, match=r"the points of the first pass must be .* got .*4, 2"):
        adapt(scene, TARGET, points=np.zeros((4, 2)))
    hollow = ms.Body.torus(0.06, 0.04)
    inside = np.array([[0.02, 0.0, 0.0]])
    ring = scene.with_(body=hollow)
    with pytest.raises(ReachError, match=collision.SUPPORT):
        static_sampler(ring, 0)(inside)


def test_the_arm_makes_every_contact(scene):
    points = scene.skin.positions[[0, 5, 11, 17]]
    recording, why = closed_loop_sampler(scene, 1)(points)
    assert (why == "").all()
    assert len(recording.time) == 4
    assert recording.force == pytest.approx(3.0, rel=0.02)
    off = np.linalg.norm(recording.points[:, None] - points, axis=2).min(axis=0)
    assert off.max() < 0.2e-3
    assert (np.diff(recording.time) > 0.3).all()
    twice = concatenate(recording, recording)
    assert len(twice.time) == 8
    assert len(twice.pressure) == 2 * len(recording.pressure)
    assert (twice.reading_contact < 8).all()


def test_the_last_contact_of_a_slide_is_kept(scene):
    whole = ms.simulate(scene, 1)
    kept = settled_contacts(whole)
    assert kept.time.tolist() == [whole.time[-1]]
    assert len(kept.pressure) == (whole.reading_contact == len(whole.time) - 1).sum()


def test_static_contacts_need_no_arm_and_do_not_slide(scene):
    ideal = scene.with_(effects=())
    points = scene.body.closest(scene.skin.positions).point
    (first, _), (second, _) = map(static_sampler(ideal, 0), (points[:9], points[9:]))
    # a contact at rest neither shears nor is anywhere else when it is read or recorded
    still = (Friction(0.8), Sampling(40.0, 3e-3), ScanOrder(5))
    touch = static_sampler(ideal.with_(effects=still), 0)
    for half, plain in ((points[:9], first), (points[9:], second)):
        found, _ = touch(half)
        assert np.array_equal(found.points, plain.points)
        np.testing.assert_allclose(found.pressure, plain.pressure, rtol=1e-12)
    # the body's pose is its own, not an arm's
    heavy, _ = static_sampler(ideal.with_(effects=(GravityError(0.1),)), 0)(points)
    assert heavy.force == pytest.approx(3.0 - 0.980665, rel=1e-9)  # the skin faces straight down
    with pytest.raises(ConfigError, match=r"needs the joints .* touch by the closed loop"):
        static_sampler(scene.with_(effects=(Encoder(),)), 0)


def test_drift_continues_between_rounds(scene):
    warm = TemperatureDrift(gain_drift=1.0, offset_relative=0.0, time_constant=2.0)
    touch = static_sampler(scene.with_(effects=(warm,)), 0)
    point = scene.body.closest(scene.skin.positions[:1]).point
    cold, later = (float(touch(point)[0].pressure.max()) for _ in range(2))
    assert later / cold == pytest.approx(2.0 - np.exp(-0.5))  # a second of rest between
