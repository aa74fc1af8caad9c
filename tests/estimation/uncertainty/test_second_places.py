"""Ids that were exchanged during the recording are named; second contacts anywhere are not."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty.second_places import (
    SecondPlaces,
    exchanged_taxels,
    second_places,
)
from meshskin.geometry.region import Cap
from tests.estimation.conftest import World, changed


@pytest.fixture(scope="module")
def wide():
    """A skin whose taxels are up to 50 mm apart."""
    return World(extent=25e-3)


def exchanged(world, recording, share):
    """The recording with ids reversed among a share of the taxels in its second half."""
    n = len(world.ids)
    picked = np.sort(np.random.default_rng(1).choice(n, round(share * n), replace=False))
    other = world.ids.copy()
    other[picked] = world.ids[picked][::-1]
    ids, late = recording.reading_taxel, recording.reading_contact > len(world.points) // 2
    index = np.searchsorted(world.ids, ids)
    return changed(recording, taxel=np.where(late, other[index], ids).astype(np.int32))


@pytest.mark.deep
def test_ids_exchanged_in_half_of_the_recording():
    wide = World(extent=25e-3, step=1.5e-3)
    recording, belief = wide.record(0.01, 0.05), wide.belief(0.01, 0.05)
    found = calibrate(exchanged(wide, recording, 1.0), belief)
    off = np.linalg.norm(found.positions - wide.truth, axis=1)
    assert np.nanmax(off) > 10e-3
    assert not np.any((off > 0.3e-3) & (off > 5 * found.position_sigma))
    assert found.verdict.level == "FAIL"
    assert any("taxels answer strongly at a second place" in why for why in found.verdict.reasons)


def test_a_sound_recording_has_no_second_places(wide):
    data = gather(wide.record(0.01, 0.0), wide.belief(0.01, 0.0))
    assert len(second_places(data, wide.truth)) == 0
    assert len(second_places(data, np.full_like(wide.truth, np.nan))) == 0


def test_second_contacts_scatter_over_the_body(wide):
    """Every tenth contact is one of two at the same time: strong readings far from the point."""
    data = gather(wide.record(0.01, 0.05), wide.belief(0.01, 0.05))
    rng = np.random.default_rng(2)
    contact = np.where(
        rng.random(len(data.contact)) < 0.1,
        rng.integers(len(data.points), size=len(data.contact)),
        data.contact,
    )
    assert len(second_places(replace(data, contact=contact), wide.truth)) <= 1


def test_a_taxel_that_answers_ten_thousands_of_times(wide):
    """The readings of a short circuit: their pairs are not all compared, nor held in memory."""
    data = gather(wide.record(0.01, 0.05), wide.belief(0.01, 0.05))
    far = int(np.argmax(np.linalg.norm(data.points - wide.truth[0], axis=1)))
    more = 20_000
    many = replace(
        data,
        contact=np.append(data.contact, np.full(more, far)),
        taxel=np.append(data.taxel, np.zeros(more, dtype=int)),
        pressure=np.append(data.pressure, np.full(more, data.pressure.max())),
    )
    tracemalloc.start()
    found = second_places(many, wide.truth)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.tolist() == [0]
    assert peak < 200e6


@pytest.mark.deep
def test_the_level_is_that_of_the_share_of_taxels(wide):
    recording, belief = wide.record(0.01, 0.05), wide.belief(0.01, 0.05)
    sound = calibrate(recording, belief)
    assert SecondPlaces(gather(recording, belief), sound).findings() == []
    few = gather(exchanged(wide, recording, 0.08), belief)
    order = np.random.default_rng(0).permutation(len(few.points))
    mixed = replace(few, contact=order[few.contact], points=few.points[np.argsort(order)])
    level, words = SecondPlaces(mixed, sound).findings()[0]
    taxels = second_places(mixed, wide.truth)
    assert 0.02 * len(wide.ids) < len(taxels) <= 0.08 * len(wide.ids)
    assert level == ("FAIL" if len(taxels) > 0.05 * len(wide.ids) else "DOUBT")
    assert f"{len(taxels)} of {len(wide.ids)} taxels" in words
    assert str(wide.ids[taxels[0]]) in words
    taxels, both, _ = exchanged_taxels(
        few, sound.positions
    )  # of the few that answer in both halves
    assert 0.05 * len(both) < len(taxels) <= 0.08 * len(wide.ids)
    level, words = SecondPlaces(few, sound).findings()[0]
    assert level == "FAIL"
    assert "recording on" in words


def swept(skin, body, seed):
    """A log of contacts in lanes 2.5 mm apart, back and forth."""
    rng = np.random.default_rng(seed)
    near = skin.positions[rng.integers(len(skin), size=600)]
    points = body.closest(near + rng.uniform(-5e-3, 5e-3, (600, 3))).point
    lane = np.floor(points[:, 0] / 2.5e-3).astype(int)
    return points[np.lexsort((points[:, 1] * np.where(lane % 2, 1, -1), lane))]


@pytest.mark.deep
def test_ids_of_a_module_that_are_off_by_one_from_midway():
    """In lanes few taxels answer before and after it; the second places are next to the first."""
    base = ms.Scene.load("sphere_noisy")
    region = Cap(direction=(0.0, 0.0, 1.0))
    skin = ms.Skin.cover(base.body, spacing=6e-3, count=40, seed=1, region=region)
    scene = base.with_(body=base.body, skin=skin)
    made = ms.press(scene, swept(skin, base.body, 1), force=3.0, seed=1)
    sound, belief = ms.Recording(made.contacts, made.readings, {}), scene.belief(noise_sigma=None)
    found = exchanged_taxels(gather(sound, belief), skin.positions)
    assert [len(rows) for rows in found[:2]] == [0, 0]
    ids, late = sound.reading_taxel, sound.reading_contact >= 300
    wrong = np.where(late & (ids >= 10) & (ids < 20), 10 + (ids - 9) % 10, ids)
    log = changed(sound, taxel=wrong.astype(np.int32))
    found = ms.calibrate(log, belief)
    taxels, both, part = exchanged_taxels(gather(log, belief), found.positions)
    assert len(taxels) >= 2
    assert set(skin.ids[taxels]) <= set(range(10, 20))
    assert set(taxels) <= set(both)
    assert 0.35 < part < 0.65
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    assert np.nanmax(error) > 5e-3
    assert not np.any((error > 0.3e-3) & (error > 5 * found.position_sigma))
    assert found.verdict.level == "FAIL"
    assert any("at a second place" in why for why in found.verdict.reasons)


def test_taxels_between_two_lanes_as_far_apart_as_a_patch_is_wide():
    """They answer strongly in both lanes, one after the other, and lie between them: ids that are
    in order came out as exchanged, and sigmas as wide as the body."""
    base, lane = ms.Scene.load("sphere_noisy"), 6e-3
    skin = ms.Skin.cover(base.body, spacing=6e-3, count=60, seed=1, region=Cap((0.0, 0.0, 1.0)))
    scene = base.with_(body=base.body, skin=skin)
    x, y = np.arange(-30e-3, 30e-3, lane), np.arange(-30e-3, 30e-3, 0.5e-3)
    flat = [[u, v, 0.1] for k, u in enumerate(x) for v in (y if k % 2 else y[::-1])]
    made = ms.press(scene, base.body.closest(np.array(flat)).point, force=3.0, seed=1)
    data = gather(made, scene.belief())
    taxels, _, _ = exchanged_taxels(data, np.full((60, 3), np.nan))
    assert len(taxels) > 1  # as far as their readings alone tell
    assert len(exchanged_taxels(data, skin.positions)[0]) == 0


@pytest.mark.deep
def test_two_taxels_that_exchange_their_ids_midway_state_no_small_sigma():
    """Each answers as often at one place as at the other: neither is more likely its own."""
    base = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(base.body, spacing=6e-3, count=30, seed=1, region=Cap((0.0, 0.0, 1.0)))
    scene, rng = base.with_(body=base.body, skin=skin), np.random.default_rng(3)
    near = skin.positions[rng.integers(30, size=400)]
    points = base.body.closest(near + rng.uniform(-5e-3, 5e-3, (400, 3))).point
    made = ms.press(scene, points, force=3.0, seed=1)
    log, pair = ms.Recording(made.contacts, made.readings, {}), skin.ids[[3, 26]]
    ids, late = log.reading_taxel, log.reading_contact >= 200
    first, second = (late & (ids == one) for one in pair)
    other = np.select([first, second], pair[::-1].tolist(), ids).astype(np.int32)
    order = np.lexsort((other, log.reading_contact))
    swapped = changed(log, taxel=other)
    swapped = replace(swapped, readings=swapped.readings.take(order))
    found = ms.calibrate(swapped, scene.belief(contact="hertz", noise_sigma=None))
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    assert np.isfinite(error).sum() >= 28
    assert not np.any((error > 0.3e-3) & (error > 5 * found.position_sigma))
