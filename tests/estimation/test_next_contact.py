"""Next contacts: aimed at the most uncertain taxel, with the predicted uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.next_contact import next_touch, valid_contacts
from meshskin.simulation.contact_samplers import concatenate


def thinned(world, taxel, contacts, sigma=0.01):
    """A recording in which one taxel has been pressed by few contacts only."""
    gap = np.linalg.norm(world.points - world.truth[taxel], axis=1)
    near, some = gap < 7e-3, np.flatnonzero(gap < 4e-3)
    keep = ~near
    keep[some[np.linspace(0, len(some) - 1, contacts).astype(int)]] = True
    return pressed(world, world.points[keep], sigma), keep


def pressed(world, points, sigma=0.01, seed=1):
    """What the world records when it is pressed at `points` (m, 3)."""
    other = replace(world)
    other.points = points
    other.normals = world.body.closest(points).normal
    other.force = np.full(len(points), 3.0)
    modulus = world.modulus
    other.a = (0.75 * other.force / (10 + 100) / modulus) ** (1 / 3)
    other.peak = 1.5 / np.pi * other.force / other.a**2
    return other.record(sigma, 0.05, seed)


def sigma_of(found, row):
    return float(np.sqrt(np.trace(found.covariances[row, :2, :2])))


@pytest.mark.slow
def test_the_worst_taxel_is_aimed_at_and_gains_what_is_promised(world):
    belief = world.belief(0.01, 0.05)
    recording, _ = thinned(world, 18, 5)
    found = calibrate(recording, belief)
    assert np.argmax(found.position_sigma) == 18
    plan = found.next_contacts(3)
    assert plan.points.shape == plan.normals.shape == (3, 3)
    assert plan.taxel[0] == world.ids[18]
    assert (np.diff(plan.worst) <= 1e-12).all()
    assert plan.worst[-1] < 0.75 * sigma_of(found, 18)
    assert np.abs(world.body.closest(plan.points).distance).max() < 1e-9
    more = calibrate(concatenate(recording, pressed(world, plan.points)), belief)
    worst = more.position_sigma.max()
    assert worst == pytest.approx(plan.worst[-1], rel=0.25)
    rng = np.random.default_rng(0)
    blind = []
    for _ in range(5):
        anywhere = world.points[rng.choice(len(world.points), 3, replace=False)]
        again = calibrate(concatenate(recording, pressed(world, anywhere)), belief)
        blind.append(again.position_sigma.max())
    assert worst < 0.85 * np.mean(blind)


@pytest.mark.deep
def test_a_taxel_touched_too_seldom_is_determined_afterwards(world):
    belief = world.belief(0.01, 0.05)
    recording, _ = thinned(world, 18, 1)
    found = calibrate(recording, belief)
    assert not found.observed[18].any()
    assert found.touched[18]
    plan = found.next_contacts(4)
    assert (plan.taxel == world.ids[18]).sum() >= 2
    more = calibrate(concatenate(recording, pressed(world, plan.points)), belief)
    assert more.observed[18, :2].all()
    assert np.linalg.norm(more.positions[18] - world.truth[18]) < 0.2e-3


def test_next_contacts_that_cannot_be_planned(world, change, tmp_path):
    belief = world.belief(0.01, 0.05)
    recording = world.record(0.01, 0.05)
    found = calibrate(change(recording, keep=recording.reading_taxel != world.ids[4]), belief)
    assert found.next_contacts(1).unreached.tolist() == [world.ids[4]]
    with pytest.raises(CalibrationError, match="at least 1"):
        found.next_contacts(0)
    found.save(tmp_path / "c")
    again = Calibration.load(tmp_path / "c")
    with pytest.raises(CalibrationError, match="give next_contacts a belief"):
        again.next_contacts(2)
    same = again.next_contacts(2, belief)
    assert np.allclose(same.points, found.next_contacts(2).points)


def test_the_contact_model_of_the_command_line(world, tmp_path):
    """A loaded calibration and contact="auto": the first model that holds at the taxels."""
    belief = world.belief(0.01, 0.05)
    calibrate(world.record(0.01, 0.05), belief).save(tmp_path / "c")
    auto = ms.Belief(
        body=ms.Body.sphere(0.1), indenter=ms.Indenter.sphere(0.01), material=belief.material,
        taxel_ids=world.ids, contact="auto", force_reference=3.0,
        noise_sigma=belief.noise_sigma, threshold=belief.threshold,
    )  # fmt: skip
    loaded = Calibration.load(tmp_path / "c")
    found, named = (
        loaded.next_contacts(2, replace(auto, contact=name)) for name in ("auto", "hertz")
    )
    assert np.allclose(found.points, named.points)
    with pytest.raises(CalibrationError, match="need a reference force"):
        loaded.next_contacts(2, replace(auto, force_reference=None))


def test_touches_are_planned_only_where_the_contact_model_holds():
    body = ms.Body.torus(0.1, 0.04)
    inside, outside = np.array([0.06, 0.0, 0.0]), np.array([0.14, 0.0, 0.0])
    belief = ms.Belief(
        body, ms.Indenter.sphere(0.07), ms.Material(2e5), np.arange(1), contact="elliptic",
        force_reference=1.0,
    )  # fmt: skip
    modulus = belief.material.effective_modulus
    hit = valid_contacts(np.stack([inside, outside]), belief, modulus)
    np.testing.assert_allclose(hit.point, [outside], atol=1e-4)
    spread = 1e-6 * np.eye(3)[None]
    told = [
        next_touch(np.arange(1), place[None], spread, belief, modulus, radius=3e-3)
        for place in (inside, outside)
    ]
    assert told[0] is None
    assert np.linalg.norm(told[1].point - outside) < 0.02
