"""Rigid modules: observable rotation, dead and swapped taxels."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.core.errors import CalibrationError
from meshskin.estimation import chart
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.uncertainty.metrics import nees, nees_band, position_errors
from meshskin.skin import slots

TAXELS = np.array(slots.TAXELS)


class Tiled:
    """Seven modules on the small world's sphere, as near to it as their taxels can."""

    def __init__(self, world):
        self.world = type(world)(extent=30e-3)
        around = np.arange(6) * np.pi / 3
        ring = 18.3e-3 * np.column_stack([np.cos(around), np.sin(around)])
        hit = self.world.body.closest(self.world.raise_(np.vstack([[0.0, 0.0], ring])))
        spin = np.random.default_rng(0).uniform(-3, 3, 7)
        self.rotations = chart.frames(hit.normal) @ se3.exp_so3(spin[:, None] * [0, 0, 1.0])
        arms = np.einsum("gij,sj->gsi", self.rotations, slots.OFFSETS[TAXELS])
        origins = hit.point
        for _ in range(5):
            off = self.world.body.closest((origins[:, None] + arms).reshape(-1, 3)).distance
            origins = origins - off.reshape(7, -1).mean(axis=1)[:, None] * hit.normal
        self.world.truth = (origins[:, None] + arms).reshape(-1, 3)
        self.world.ids = (12 * np.arange(7)[:, None] + TAXELS).ravel()
        self.belief = self.world.belief(0.01, 0.05, module_slots=slots.OFFSETS)


@pytest.fixture(scope="module")
def tiled(world):
    return Tiled(world)


@pytest.fixture(scope="module")
def clean(tiled):
    recording = tiled.world.record(0.01, 0.05)
    return recording, calibrate(recording, tiled.belief)


def spin_errors(tiled, found):
    turned = np.swapaxes(found.poses[:, :3, :3], 1, 2) @ np.repeat(tiled.rotations, 10, axis=0)
    return se3.log_so3(turned)[:, 2]


@pytest.mark.deep
def test_modules_show_all_six_degrees_of_freedom(tiled, clean):
    recording, found = clean
    assert found.observed.all()
    sigma = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    assert sigma[:, 5].max() < 1e-3
    assert np.abs(spin_errors(tiled, found) / sigma[:, 5]).max() < 4
    free = calibrate(recording, tiled.world.belief(0.01, 0.05))
    along = [
        np.linalg.norm(
            np.einsum("nji,nj->ni", c.poses[:, :3, :3], tiled.world.truth - c.positions)[:, :2],
            axis=1,
        ).mean()
        for c in (found, free)
    ]
    assert along[0] < 0.6 * along[1]
    assert position_errors(found, tiled.world.skin).mean() < 40e-6
    assert any("rigid modules" in factor for factor in found.factors)
    assert not any(found.faults)


@pytest.mark.slow
def test_modules_are_consistent_over_seeds(tiled):
    normalized, spin = [], []
    for seed in range(30):
        found = calibrate(tiled.world.record(0.01, 0.05, seed), tiled.belief)
        # ten taxels of a module share one pose: one of them speaks for it
        normalized.append(nees(found, tiled.world.skin).reshape(7, 10)[:, 3])
        spin.append((spin_errors(tiled, found) ** 2 / found.covariances[:, 5, 5])[::10])
    low, high = nees_band(30 * 7)
    assert low < np.mean(normalized) < high
    assert abs(np.mean(spin) - 1) < 2 * np.sqrt(2 / (30 * 7))


def test_a_dead_taxel_is_placed_and_named(tiled, clean, change):
    recording = clean[0]
    found = calibrate(change(recording, keep=recording.reading_taxel != 14), tiled.belief)
    row = int(np.flatnonzero(found.ids == 14)[0])
    assert "silent in" in found.faults[row]
    assert not found.touched[row]
    assert position_errors(found, tiled.world.skin)[row] < 60e-6
    assert sum(fault != "" for fault in found.faults) == 1


@pytest.mark.deep
def test_a_dead_taxel_among_taxels_of_different_gain_is_named(tiled, clean, change):
    recording = clean[0]
    gain = np.exp(0.1 * np.random.default_rng(3).normal(size=70))
    place = np.argsort(tiled.belief.taxel_ids)[
        np.searchsorted(np.sort(tiled.belief.taxel_ids), recording.reading_taxel)
    ]
    pressure = recording.pressure * gain[place]
    keep = (recording.reading_taxel != 14) & (pressure > tiled.belief.threshold)
    bent = change(recording, pressure=pressure)
    found = calibrate(change(bent, keep=keep), tiled.belief)
    assert list(found.ids[found.faults != ""]) == [14]
    assert "silent in" in found.faults[found.ids == 14][0]
    assert "gain" in found.taxel_unknowns


@pytest.mark.slow
def test_swapped_taxels_are_named(tiled, clean, change):
    recording = clean[0]
    taxel = recording.reading_taxel.copy()
    taxel[recording.reading_taxel == 15] = 20
    taxel[recording.reading_taxel == 20] = 15
    found = calibrate(change(recording, taxel=taxel), tiled.belief)
    faults = dict(zip(found.ids, found.faults, strict=True))
    assert "swapped with 20" in faults[15]
    assert "swapped with 15" in faults[20]
    assert position_errors(found, tiled.world.skin).mean() < 40e-6


def test_modules_with_one_determined_taxel_are_refused(tiled, clean, change):
    recording = clean[0]
    few = np.isin(recording.reading_taxel, [0, 12, 24])
    with pytest.raises(CalibrationError, match=r"no module has two taxels.*leave module_slots"):
        calibrate(change(recording, keep=few), tiled.belief)


def test_taxels_that_are_not_arranged_in_modules_are_refused(tiled, clean, change):
    recording, _ = clean
    ids = tiled.world.ids
    other = ids[np.random.default_rng(0).permutation(len(ids))]
    wrong = change(recording, taxel=other[np.searchsorted(ids, recording.reading_taxel)])
    with pytest.raises(
        CalibrationError, match=r"are not arranged as in the rigid.* mm off.*12 module"
    ):
        calibrate(wrong, tiled.belief)


def test_the_belief_of_a_scene_of_modules_has_their_layout():
    base = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.modules(base.body, 2).skin
    scene = base.with_(skin=skin)
    assert np.array_equal(scene.belief().module_slots, slots.OFFSETS)
    assert scene.belief(module_slots=None).module_slots is None
    assert scene.with_(skin=skin.onto(base.body)).belief().module_slots is None  # bent
    assert base.belief().module_slots is None
