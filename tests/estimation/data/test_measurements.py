"""Measurements refuse recordings and beliefs that do not belong together."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import meshskin as ms
from meshskin import Body, Cap, Indenter, Loop, Readout, Scene, Skin, effects, simulate
from meshskin.core.errors import CalibrationError
from meshskin.estimation.data import delay, delay_changes, unit_checks
from meshskin.estimation.data.gather import gather
from meshskin.recording.recording import Recording


@pytest.mark.parametrize("factor", [1e-3, 1e3, 1e-6])
def test_a_wrong_unit_of_contact_points_is_named(world, factor):
    recording = world.record()
    with pytest.raises(CalibrationError, match=re.escape(f"times {1 / factor:g} they are on it")):
        gather(recording.with_columns(points=factor * recording.points), world.belief())


def test_contact_points_of_another_frame_keep_the_general_remedy(world):
    recording = world.record()
    with pytest.raises(CalibrationError, match="in the body's frame"):
        gather(recording.with_columns(points=3.0 * recording.points), world.belief())


def test_headings_must_be_one_for_each_contact(world):
    recording = world.record()
    few = np.broadcast_to(np.eye(3), (len(recording.time) - 1, 3, 3))
    with pytest.raises(CalibrationError, match=rf"one rotation .* got shape \({len(few)}, 3, 3\)"):
        gather(recording, world.belief(unknown=("indenter_offset",), headings=few))


@pytest.mark.parametrize("factor", [100.0, 0.01])
def test_pressures_that_no_plausible_modulus_explains_are_refused(world, factor):
    """E* may be wrong by a factor of 100, which changes the peak by 100^(2/3); units may not."""
    recording = world.record()
    wrong = recording.with_columns(pressure=factor * recording.pressure)
    with pytest.raises(CalibrationError, match="the pressures cannot be in Pa"):
        gather(wrong, world.belief())
    peaks = np.full(3, 1e4 * factor ** (2 / 3))
    unit_checks.check_pressure(np.full(3, 1e4), np.zeros(3, dtype=int), peaks)


def test_forces_in_another_unit_are_refused_and_weak_ones_are_not(world):
    unit_checks.check_force(np.full(5, 0.05), 3.0)
    for factor in (150.0, 1 / 150.0):
        with pytest.raises(CalibrationError, match="the forces cannot be in N"):
            unit_checks.check_force(np.full(5, 3.0 * factor), 3.0)


def test_a_disc_far_larger_than_the_response_is_refused(world):
    recording = world.record()
    for radius in (1e-3, 4e-3):
        gather(recording, world.belief(disc_radius=radius))
    with pytest.raises(CalibrationError, match=r"disc radius .* got 40 mm"):
        gather(recording, world.belief(disc_radius=40e-3))


@pytest.mark.parametrize("frames", [-1, 2])
def test_late_readings_are_moved_to_their_contacts(world, frames):
    """Lanes in one direction do not show a delay: the contacts are taken in random order."""
    whole = world.record()
    order = np.random.default_rng(0).permutation(len(whole.time))
    contacts = whole.contacts.take(pa.array(order)).set_column(0, "time", pa.array(whole.time))
    right = np.argsort(order)[whole.reading_contact]

    def recording(row):
        kept = (row >= 0) & (row < len(whole.time))
        readings = whole.readings.filter(pa.array(kept))
        time = pa.array(whole.time[row[kept]])
        return Recording(contacts, readings.set_column(0, "time", time), {})

    truth = gather(recording(right), world.belief())
    found = gather(recording(right + frames), world.belief())
    assert (truth.delay, found.delay) == (0, frames)
    pairs = [
        set(zip(d.contact.tolist(), d.taxel.tolist(), d.pressure.tolist(), strict=True))
        for d in (found, truth)
    ]
    assert pairs[0] == {p for p in pairs[1] if 0 <= p[0] + frames < len(whole.time)}
    assert {p[0] for p in pairs[1] - pairs[0]} <= set(found.unread.tolist())
    assert len(found.unread) == abs(frames)
    row = truth.contact + frames
    inside = (row >= 0) & (row < len(truth.points))
    first = inside & np.isin(truth.taxel, np.unique(truth.taxel)[:9])
    seen = [
        delay.late_frames(dataclasses.replace(truth.select(k), contact=row[k]))
        for k in (inside, first)
    ]
    assert seen == [frames, 0]  # nine taxels may show it by chance


def strokes_both_ways(whole):
    """The order of the contacts with every second lane reversed, and these contacts."""
    jumps = np.linalg.norm(np.diff(whole.points, axis=0), axis=1) > 1e-3
    lane = np.cumsum(np.append(0, jumps))
    rows = [np.flatnonzero(lane == k) for k in range(lane[-1] + 1)]
    order = np.concatenate([row[::-1] if k % 2 else row for k, row in enumerate(rows)])
    contacts = whole.contacts.take(pa.array(order)).set_column(0, "time", pa.array(whole.time))
    return order, contacts


def test_one_frame_shows_in_strokes_both_ways(world):
    """0.5 mm a frame: the contacts of a taxel spread by 4 % more."""
    whole = world.record(0.01, 0.05)
    order, contacts = strokes_both_ways(whole)
    for frames in (0, 1):
        row = np.argsort(order)[whole.reading_contact] + frames
        readings = whole.readings.filter(pa.array(row < len(order)))
        time = pa.array(whole.time[row[row < len(order)]])
        late = Recording(contacts, readings.set_column(0, "time", time), {})
        assert gather(late, world.belief(0.01, 0.05)).delay == frames


@pytest.mark.parametrize(("before", "after"), [(0, 3), (2, -1)])
def test_a_delay_that_changes_in_the_course_of_a_recording(world, before, after):
    """Of contacts in random order, at 60 % of them."""
    whole = world.record()
    m = len(whole.time)
    order = np.random.default_rng(0).permutation(m)
    contacts = whole.contacts.take(pa.array(order)).set_column(0, "time", pa.array(whole.time))
    right = np.argsort(order)[whole.reading_contact]

    def recording(row, kept):
        readings = whole.readings.filter(pa.array(kept))
        time = pa.array(whole.time[row[kept]])
        return Recording(contacts, readings.set_column(0, "time", time), {})

    row = right + np.where(right < 0.6 * m, before, after)
    clear = (np.abs(right - 0.6 * m) > abs(after - before)) & (row >= 0) & (row < m)
    truth = gather(recording(right, clear), world.belief())
    found = gather(recording(row, clear), world.belief())
    assert truth.delays == ()
    assert found.delay == before
    (_, first), (part, second) = found.delays
    assert (first, second) == (before, after)
    assert abs(part - 0.6) < 0.02
    pairs = [
        set(zip(d.contact.tolist(), d.taxel.tolist(), d.pressure.tolist(), strict=True))
        for d in (found, truth)
    ]
    assert len(pairs[0] - pairs[1]) < 0.02 * len(pairs[1])
    assert len(pairs[1] - pairs[0]) < 0.03 * len(pairs[1])
    assert len(found.unread) >= abs(before)
    assert not np.isin(found.contact, found.unread).any()


def recorded_late(world, late, share=1.0):
    """A share of the contacts in random order, with readings late by late(part) frames of the part
    (m,) of the contacts before each: without those after the end, or that others come before."""
    whole = world.record()
    order = np.random.default_rng(0).permutation(len(whole.time))
    m = round(share * len(order))
    contacts = whole.contacts.take(pa.array(order[:m]))
    contacts = contacts.set_column(0, "time", pa.array(whole.time[:m]))
    right = np.argsort(order)[whole.reading_contact]
    row = np.where(right < m, right + late(right / m), m)
    _, first = np.unique(np.stack([row, whole.reading_taxel]), axis=1, return_index=True)
    rows = np.sort(first)[row[np.sort(first)] < m]
    readings = whole.readings.take(pa.array(rows))
    return Recording(contacts, readings.set_column(0, "time", pa.array(whole.time[row[rows]])), {})


@pytest.mark.parametrize(("begin", "end"), [(0, 1 / 6), (5 / 6, 1), (0.4, 0.6)])
def test_a_delay_in_a_part_of_a_recording(world, begin, end):
    log = recorded_late(world, lambda part: 3 * ((part >= begin) & (part < end)))
    found = gather(log, world.belief())
    inside = [(part, frames) for part, frames in found.delays if frames]
    assert inside == [(pytest.approx(begin, abs=0.02), 3)]
    after = [part for part, _ in found.delays if part > begin + 0.1]
    assert after == ([] if end == 1 else [pytest.approx(end, abs=0.02)])


def test_late_readings_of_which_taxels_have_few(world):
    """Seven each, as in a quick log; those in time are not late."""
    for frames in (0, 2):
        log = recorded_late(world, lambda part, k=frames: k + 0 * part.astype(int), share=0.1)
        found = gather(log, world.belief())
        assert 5 <= np.median(found.counts[found.counts > 0]) < 10
        assert (found.delay, found.delays) == (frames, ())


def test_late_readings_along_a_spiral_of_which_taxels_have_few(noisy):
    """Passes over a taxel have one direction: moved along it, their contacts spread by 5 % less."""
    turns = np.sqrt(np.linspace(0, 1, 750)) * 2 * np.pi * 12
    way = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))]) * turns[:, None]
    axes = np.linalg.svd(noisy.skin.positions - noisy.skin.positions.mean(axis=0))[2]
    centre = noisy.skin.positions.mean(axis=0)
    points = noisy.body.closest(centre + 2.5e-3 / (2 * np.pi) * way @ axes).point
    log = ms.press(noisy, points, force=0.3, seed=0)
    for frames in (0, 3):
        row = log.reading_contact + frames
        kept = row < len(points)
        readings = log.readings.filter(pa.array(kept))
        readings = readings.set_column(0, "time", pa.array(log.time[row[kept]]))
        found = gather(Recording(log.contacts, readings, {}), noisy.belief())
        assert 5 <= np.median(found.counts[found.counts > 0]) < 10
        assert found.delay == frames


def test_a_clock_that_runs_faster(world):
    """By five frames in the course of the recording."""
    found = gather(recorded_late(world, lambda part: np.rint(5 * part).astype(int)), world.belief())
    assert [frames for _, frames in found.delays] == [0, 1, 2, 3, 4, 5]


@pytest.mark.deep
@pytest.mark.parametrize("direction", [(1, 0, 0), (1, 0.3, 0), (0, 0, 1)])
def test_passes_that_end_at_edges_are_not_late(direction):
    """Of a simulated box: few passes over a taxel spread less, by chance, with a wrong delay."""
    body = Body.from_mesh(trimesh.creation.box([0.06, 0.04, 0.03]))
    skin = Skin.cover(body, spacing=5e-3, count=40, region=Cap(direction))
    scene = Scene(
        body=body,
        skin=skin,
        indenter=Indenter.sphere(5e-3),
        effects=[effects.find("gaussian_noise")(sigma_relative=0.01)],
        readout=Readout(threshold_relative=0.05),
        loop=Loop(mode="quasi_static"),
    )
    found = gather(simulate(scene, seed=1), scene.belief())
    assert (found.delay, found.delays) == (0, ())


def test_patches_that_are_dragged_along_are_not_late(world):
    """By 0.7 mm at 0.5 mm a frame, which one frame explains nearly as well."""
    whole = world.record(0.01, 0.05)
    order, contacts = strokes_both_ways(whole)
    time = pa.array(whole.time[np.argsort(order)[whole.reading_contact]])
    recording = Recording(contacts, whole.readings.set_column(0, "time", time), {})
    data = gather(recording, world.belief(0.01, 0.05))
    dragged = dataclasses.replace(data, points=data.points + 0.7e-3 * data.headway)
    row, used = delay._moved(data, 1)
    one_late = dataclasses.replace(data.select(used), contact=row[used])
    assert [delay.late_frames(d) for d in (data, dragged, one_late)] == [0, 0, 1]


def test_pauses_show_no_delay_and_are_not_crossed(world):
    """Contacts one by one, at irregular times: no other contact is in time."""
    whole = world.record()
    time = np.cumsum(10.0 ** np.random.default_rng(0).uniform(0, 4, len(whole.time)))
    recording = Recording(
        whole.contacts.set_column(0, "time", pa.array(time)),
        whole.readings.set_column(0, "time", pa.array(time[whole.reading_contact])),
        {},
    )
    assert gather(recording, world.belief()).delay == 0


def test_a_reading_beyond_a_pause_is_left_out(world):
    data = gather(world.record(), world.belief())
    middle = len(data.points) // 2
    time = data.time + 100.0 * (np.arange(len(data.points)) >= middle)
    frames = 2
    with_pause = dataclasses.replace(data, time=time)
    row, inside = delay._moved(with_pause, -frames)
    crosses = (data.contact >= middle) & (row < middle)
    assert crosses.any()
    np.testing.assert_array_equal(inside, (row >= 0) & ~crosses)


@pytest.mark.deep
def test_contacts_moved_into_a_hollow_keep_the_curvatures_that_they_have(noisy, noisy_recording):
    """As at the creases of a mesh, where unknown offsets move contacts: no trial ends the run."""
    data = gather(noisy_recording, noisy.belief())
    hit = data.body.closest(data.points)
    tight = hit.curvature.copy()
    tight[::2] = -130.0  # the indenter has 100 1/m
    moved = data.at_contacts(dataclasses.replace(hit, curvature=tight))
    np.testing.assert_array_equal(moved.curvature[::2], data.curvature[::2])
    np.testing.assert_array_equal(moved.curvature[1::2], tight[1::2])
    assert np.isfinite(moved.patches.first).all()


def test_contacts_at_random_places_move_to_the_next_one_at_their_speed(world):
    """Twice as fast to a contact half of a frame later; those of a path have no speed."""
    data = gather(world.record(), world.belief())
    assert np.linalg.norm(data.headway, axis=1).max() < 1 + 1e-9
    order = np.random.default_rng(0).permutation(len(data.points))
    time = data.time.copy()
    time[1::2] = time[:-1:2] + (time[1] - time[0]) / 2
    points, normals = data.points[order], data.normals[order]
    headway = dataclasses.replace(data, points=points, normals=normals, time=time).headway
    way = np.diff(points, axis=0)
    way -= np.sum(way * normals[:-1], axis=1, keepdims=True) * normals[:-1]
    speed = way / np.diff(time)[:, None]
    ratio = np.linalg.norm(headway[:-1], axis=1) / np.linalg.norm(speed, axis=1)
    np.testing.assert_allclose(ratio, ratio[0])
    np.testing.assert_allclose(headway[:-1], ratio[0] * speed, atol=1e-12)
    assert not headway[-1].any()
    # by the golden angle the ways are a turn and a shrinkage of all places: no reading shows these
    turns = np.pi * (1 + 5**0.5) * np.arange(len(data.points))
    flat = np.sqrt(np.arange(len(turns)))[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    normals = np.tile([0.0, 0.0, 1.0], (len(turns), 1))
    spiral = dataclasses.replace(data, points=1e-3 * flat @ np.eye(2, 3), normals=normals)
    np.testing.assert_allclose(np.linalg.norm(spiral.headway[1:], axis=1), 1)


def test_single_passes_that_end_or_begin_over_a_taxel_tell_no_delay():
    """A delay, of another sign for each, spreads the contacts of such a pass less: those of the
    first half of 60 taxels were taken for 2 frames early, those of the second for as late."""
    steps = [np.arange(-20, 1) if k < 30 else np.arange(21) for k in range(60)]
    pass_of = np.repeat(np.arange(60), [len(s) for s in steps])
    along = 0.3e-3 * np.concatenate(steps)
    points = np.column_stack([0.02 * pass_of + along, np.zeros((len(along), 2))])
    read = np.flatnonzero(np.abs(along) < 2e-3)
    lags = np.array(delay_changes.LAGS)[:, None]
    before = read - lags
    there = (before >= 0) & (before < len(points))
    in_time = there & (pass_of[np.where(there, before, 0)] == pass_of[read])
    data = SimpleNamespace(
        points=points, contact=read, taxel=pass_of[read], ids=np.arange(60),
        counts=np.bincount(pass_of[read], minlength=60),
    )  # fmt: skip
    course = delay_changes.delay_course(data, in_time, 1 - np.abs(along[read]) / 2e-3)
    assert not course.any()
