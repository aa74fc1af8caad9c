"""An earlier map of raw readings, whose response was learned, tested by a few touches."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import norm

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.recalibrate.evidence import Evidence, log_chance
from meshskin.estimation.recalibrate.hypotheses import unchanged
from meshskin.estimation.recalibrate.readings import read, touches_of
from meshskin.estimation.recalibrate.result import updated
from meshskin.estimation.recalibrate.skin_map import skin_map
from meshskin.estimation.recalibrate.touches import Errors

REST = 230.0
COLUMNS = {
    "ids", "poses", "covariances", "observed", "touched", "readings", "chi2", "reasons", "faults",
    "rivals",
}  # fmt: skip
"""Fields of a calibration with a row a taxel."""


@pytest.fixture(scope="module")
def world():
    """Twelve taxels of a sphere, and places of many touches and of few."""
    scene = ms.Scene.load("sphere")
    skin = ms.Skin.cover(scene.body, spacing=5e-3, count=12, seed=1)
    scene = scene.with_(skin=skin, readout=replace(scene.readout, threshold_relative=0.0))
    rng = np.random.default_rng(0)
    owner = np.tile(np.arange(12), 40)
    step = rng.normal(scale=3e-3, size=(len(owner), 2))
    points = skin.positions[owner] + np.einsum("kij,kj->ki", skin.poses[owner, :3, :2], step)
    return scene, points[:360], points[360:396]


def counts(scene, points, seed, falling, gain=None):
    """Raw readings of a saturating skin: of taxels that answer, or that fall, of all at rest."""
    recording, rng = ms.press(scene, points, seed=seed), np.random.default_rng(seed)
    ids = np.asarray(scene.skin.ids)
    level = np.zeros((len(points), len(ids)))
    column = np.searchsorted(ids, recording.reading_taxel)
    level[recording.reading_contact, column] = recording.pressure / scene.patch.peak
    gain = np.ones(len(ids)) if gain is None else gain
    own = np.exp(0.1 * np.sin(3.0 * ids))
    level = 250 * np.tanh(1.2 * gain * own * level**0.8) + rng.normal(scale=1.5, size=level.shape)
    level = np.round(level)
    contact, taxel = np.nonzero(np.isfinite(level) if falling else level > 8)
    values = REST - level[contact, taxel] if falling else level[contact, taxel]
    table = {
        "time": recording.time[contact], "taxel": ids[taxel].astype(np.int32),
        "pressure": values,
    }  # fmt: skip
    return ms.Recording(recording.contacts, pa.table(table), {"readings": "raw"})


@pytest.fixture(
    scope="module",
    params=[False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["rising", "falling"],
)
def mapped(world, request):
    scene, many, _ = world
    belief = ms.Belief(
        body=scene.body, indenter=scene.indenter, material=ms.Material(young=4e5),
        taxel_ids=scene.skin.ids, readings="raw",
    )  # fmt: skip
    recording = counts(scene, many, 1, request.param)
    return ms.calibrate(recording, belief), belief, request.param


@pytest.mark.deep
def test_changes_are_found_in_raw_readings(world, mapped, tmp_path):
    scene, _, few = world
    map_, belief, falling = mapped
    assert np.isfinite(map_.positions).all()
    gain = np.ones(12)
    gain[3], gain[8] = 0.0, 2.0
    recording = counts(scene, few, 2, falling, gain)
    map_.save(tmp_path / "map")  # a loaded map has no belief
    found = ms.recalibrate(ms.Calibration.load(tmp_path / "map.parquet"), recording, belief)
    assert {(f.number, f.state) for f in found.findings} == {(3, "dead"), (8, "gain changed")}


@pytest.mark.deep
def test_an_unchanged_skin_of_raw_readings_is_confirmed(world, mapped):
    scene, _, few = world
    map_, _, falling = mapped
    found = ms.recalibrate(map_, counts(scene, few, 3, falling))
    assert found.findings == ()
    assert (found.states == "confirmed").all()
    assert abs(found.errors.log_scale) < 0.03
    assert found.errors.rho < 0.03


def test_an_updated_map_has_the_order_of_its_belief(mapped):
    """Ids are sorted: a belief in another order would assign the readings to other taxels."""
    map_, belief, _ = mapped
    columns = {
        name: np.roll(values, 1, 0) for name, values in vars(map_).items() if name in COLUMNS
    }
    shifted = replace(
        map_, **columns,
        taxel_unknowns={k: np.roll(v, 1, 0) for k, v in map_.taxel_unknowns.items()},
        additions=np.array([[5.0, 11.0, 0.1]]), belief=belief.with_(taxel_ids=np.roll(map_.ids, 1)),
    )  # fmt: skip
    known = skin_map(shifted, belief)
    one = np.ones(1, dtype=bool)
    found = [Evidence(0.0, unchanged(known, u), (), -np.inf, one, one, True) for u in range(12)]
    now = updated(known, belief, found, (), 36)
    np.testing.assert_array_equal(now.ids, now.belief.taxel_ids)
    np.testing.assert_array_equal(now.positions, map_.positions)
    np.testing.assert_array_equal(now.additions, [[5.0, 10.0, 0.1]])


def test_raw_readings_are_predicted_by_the_learned_response(world, mapped):
    """Under other forces than those that the map was made with, as the calibration states them."""
    scene, _, few = world
    map_, belief, falling = mapped
    known, recording = skin_map(map_, belief), counts(scene, few, 4, falling)
    touches = read(recording, belief, known)
    off = []
    for unit in range(len(known.units)):
        (block,) = touches.blocks(unit, [unchanged(known, unit)], Errors(0.01, 1e-5, 1e-3))
        off.append((block.level - block.mean)[block.read])
    peak = np.nanmax(touches.level)
    assert np.std(np.concatenate(off)) < 0.03 * peak
    assert touches.compression > 0.05
    design = ms.next_touches(map_, belief.with_(force_reference=3.0), 4)
    assert len(design.points) == 4


def test_maps_without_a_response_refuse_raw_readings(world, mapped):
    scene, _, few = world
    map_, belief, falling = mapped
    recording = counts(scene, few, 2, falling)
    with pytest.raises(CalibrationError, match="whose calibration learned the response"):
        ms.recalibrate(scene.skin, recording, belief)
    older = replace(map_, response=replace(map_.response, references=()))
    with pytest.raises(CalibrationError, match="saved by an earlier version"):
        ms.recalibrate(older, recording, belief)


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_the_chance_of_an_evidence_is_that_of_a_normal_variable(part):
    """One reading of one known change: the evidence is a monotone function of the reading."""
    step, sigma, evidence = 0.35, 0.1, 4.0
    mean, c = np.array([[0.5], [0.5 + step]]), np.full((2, 1, 1), sigma**2)
    d = step / sigma
    found = log_chance(
        mean, c, np.zeros(1), np.log([part]), evidence + np.log(part), Errors(sigma, 1e-4, 0.0), 0.0
    )
    expected = norm.sf((evidence + d**2 / 2) / d)
    if part < 1:  # of the changes that are left out, Markov's bound
        expected += (1 - part) * np.exp(-evidence - np.log(part))
    assert found == pytest.approx(np.log(expected), abs=0.2)
    assert found < -evidence + 1.0


def test_touches_of_a_skin_have_the_contact_model(world):
    scene, _, few = world
    known = skin_map(scene.skin, scene.belief())
    data = read(ms.press(scene, few), scene.belief(), known).data
    assert touches_of(data, known).skin is None
