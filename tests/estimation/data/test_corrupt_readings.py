"""Single readings that no contact explains cost no more than themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.corrupt_readings import repeated_frames, spikes, stuck_readings
from meshskin.estimation.data.gather import gather
from meshskin.recording.recording import READING_SCHEMA, Recording


@pytest.fixture(scope="module")
def recording(world):
    return world.record(0.01, 0.05)


@pytest.fixture(scope="module")
def sound(world, recording):
    """The calibrations without a corrupt reading, by the noise that is stated."""
    return {noise: calibrate(recording, world.belief(noise, 0.05)) for noise in (0.01, None)}


def with_pressure(recording, row, value):
    pressure = recording.pressure.copy()
    pressure[row] = value
    return recording.with_columns(pressure=pressure)


@pytest.mark.parametrize("noise", [pytest.param(0.01, marks=pytest.mark.slow), None])
def test_a_log_that_was_joined_to_itself_tells_nothing_new(world, recording, sound, noise):
    tables = [recording.contacts, recording.readings]
    twice = []
    for table in tables:
        later = np.asarray(table["time"]) + recording.time[-1] + 1.0
        column = table.column_names.index("time")
        twice.append(pa.concat_tables([table, table.set_column(column, "time", pa.array(later))]))
    found = calibrate(Recording(*twice, recording.metadata), world.belief(noise, 0.05))
    assert found.positions == pytest.approx(sound[noise].positions, abs=1e-7)
    assert found.position_sigma == pytest.approx(sound[noise].position_sigma, rel=0.01)


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_coarse_readings_of_a_robot_that_holds_still_all_count(seed):
    """Eight places, of 30 frames each with one reading of few values; then the log twice."""
    rng, m = np.random.default_rng(seed), 240
    points, level = np.repeat(rng.normal(size=(8, 3)), 30, axis=0), rng.normal(size=m).round() + 9

    def repeated(copies):
        frame = np.arange(copies * m)
        log = SimpleNamespace(
            time=frame, points=np.tile(points, (copies, 1)), force=np.ones(copies * m),
            pressure=np.tile(level, copies), reading_contact=frame,
            reading_taxel=np.full(copies * m, 3),
        )  # fmt: skip
        return repeated_frames(log)

    one_after_another = (np.diff(level) == 0) & (np.arange(1, m) % 30 > 0)
    np.testing.assert_array_equal(repeated(1), np.append(False, one_after_another))
    np.testing.assert_array_equal(repeated(3)[:m], repeated(1))
    assert repeated(3)[m:].all()
    assert len(repeated(0)) == 0


@pytest.mark.parametrize(
    ("noise", "value"),
    [(None, 38), (None, np.nan), (0.01, -1.0)]
    + [
        pytest.param(noise, value, marks=pytest.mark.deep)
        for noise, kept in (
            (None, (330, 1e5, 1e95, np.inf, -1.0)),
            (0.01, (38, 330, 1e5, 1e95, np.inf, np.nan)),
        )
        for value in kept
    ],
)
def test_one_corrupt_reading_costs_itself(world, recording, sound, noise, value):
    belief, sound = world.belief(noise, 0.05), sound[noise]
    row = int(np.argmax(recording.pressure))
    found = calibrate(with_pressure(recording, row, value * world.peak_reference), belief)
    moved = np.linalg.norm(found.positions - sound.positions, axis=1)
    assert np.all(moved < sound.position_sigma)
    k = int(np.flatnonzero(found.ids == recording.reading_taxel[row])[0])
    assert "1 corrupt, stuck or negative readings left out" in found.faults[k]
    assert sum(map(bool, found.faults)) == 1
    assert found.readings[k] == sound.readings[k] - 1


@pytest.mark.deep
def test_a_stretch_of_one_value_over_the_skin_is_left_out(world, recording, sound):
    belief, sound = world.belief(None, 0.05), sound[None]
    m, k = len(recording.time), int(belief.taxel_ids[3])
    stuck = np.arange(m // 4, m // 4 + m // 5)
    other = (recording.reading_taxel != k) | ~np.isin(recording.reading_contact, stuck)
    contact = np.concatenate([recording.reading_contact[other], stuck])
    taxel = np.concatenate([recording.reading_taxel[other], np.full(len(stuck), k)])
    level = np.full(len(stuck), 0.3 * world.peak_reference)
    pressure = np.concatenate([recording.pressure[other], level])
    order = np.argsort(contact, kind="stable")
    columns = [recording.time[contact], taxel.astype(np.int32), pressure]
    table = pa.table([c[order] for c in columns], schema=READING_SCHEMA)
    found = calibrate(replace(recording, readings=table), belief)
    moved = np.linalg.norm(found.positions - sound.positions, axis=1)
    assert np.all(moved < np.where(sound.ids == k, 4.0, 0.5) * sound.position_sigma)
    assert f"{len(stuck)} corrupt, stuck or negative readings" in found.faults[3]
    assert "corrupt" in str(found.verdict)


def counted(world, recording, rows, values=lambda counts: counts):
    """The contacts `rows` of a recording, one second after the other, with readings of all taxels
    in steps of 1/200 of the largest, 0 at rest."""
    unit = recording.pressure.max() / 200
    every = np.zeros((len(recording.time), len(world.ids)), dtype=int)
    column = np.searchsorted(world.ids, recording.reading_taxel)
    every[recording.reading_contact, column] = recording.pressure / unit
    counts = values(every[rows])
    time = np.arange(float(len(rows)))
    contacts = recording.contacts.take(rows).set_column(0, "time", pa.array(time))
    contact, taxel = (index.ravel() for index in np.indices(counts.shape))
    columns = [time[contact], world.ids[taxel].astype(np.int32), unit * counts.ravel()]
    return Recording(contacts, pa.table(columns, schema=READING_SCHEMA), {})


def corrupt(world, recording):
    """Taxels, rows, of the readings that are left out."""
    return gather(recording, world.belief()).corrupt[:, 1]


def middle_first(world, recording):
    """Contacts: most of them in the middle of the skin, then all."""
    apart = np.linalg.norm(world.points - world.points.mean(axis=0), axis=1)
    return np.concatenate([np.tile(np.argsort(apart)[:60], 50), np.arange(len(apart))])


@pytest.mark.deep
def test_a_level_at_rest_is_not_stuck(world, recording):
    assert not len(corrupt(world, counted(world, recording, middle_first(world, recording))))


@pytest.mark.deep
def test_a_stretch_of_one_value_is_found_beside_a_level_at_rest(world, recording):
    def stuck(counts):
        counts[-400:-100, 3] = 50
        return counts

    rows = middle_first(world, recording)
    assert corrupt(world, counted(world, recording, rows, stuck)).tolist() == [3] * 300


def test_two_touches_that_saturate_a_taxel_are_not_stuck(world):
    """Each taxel is touched at one place, and few at a second one."""
    n = len(world.ids)
    points = np.repeat(world.truth, 15, axis=0)
    taxel, pressure = np.repeat(np.arange(n), 15), np.tile([0.9] * 3 + [1.0] * 12, n)
    beside = taxel[:15] + np.argsort(np.linalg.norm(world.truth - world.truth[0], axis=1))[1]
    points = np.concatenate([points, world.truth[beside]])
    taxel, pressure = np.concatenate([taxel, taxel[:15]]), np.concatenate([pressure, np.ones(15)])
    reach = world.a[0] + 2e-3
    assert not stuck_readings(pressure, taxel, points, reach).any()
    points[-15:] = world.truth[np.argmax(np.linalg.norm(world.truth - world.truth[0], axis=1))]
    assert np.flatnonzero(stuck_readings(pressure, taxel, points, reach)).size == 12 + 15


def with_readings(recording, contact, taxel, pressure):
    """The recording with further readings (k,) of the taxels (k,)."""
    contact = np.concatenate([recording.reading_contact, contact])
    taxel = np.concatenate([recording.reading_taxel, taxel]).astype(np.int32)
    pressure = np.concatenate([recording.pressure, pressure])
    order = np.argsort(contact, kind="stable")
    columns = [recording.time[contact], taxel, pressure]
    table = pa.table([c[order] for c in columns], schema=READING_SCHEMA)
    return replace(recording, readings=table)


@pytest.mark.deep
def test_spikes_cost_themselves(world, recording):
    """Interference: 1 of 200 readings is of a taxel that nothing touches."""
    rng, belief = np.random.default_rng(2), world.belief(None, 0.05)
    distance = np.linalg.norm(recording.points[:, None] - world.truth, axis=2)
    contact, taxel = np.nonzero(distance > 3.5 * (world.a[0] + 2e-3))
    few = rng.permutation(len(contact))[: len(recording.pressure) // 200]
    level = world.peak_reference * rng.uniform(0.3, 1.0, len(few))
    log = with_readings(recording, contact[few], world.ids[taxel[few]], level)
    left_out = {(int(c), int(i)) for c, i in gather(log, belief).corrupt}
    assert left_out == set(zip(contact[few].tolist(), taxel[few].tolist(), strict=True))
    sound, found = calibrate(recording, belief), calibrate(log, belief)
    moved = np.linalg.norm(found.positions - sound.positions, axis=1)
    assert np.all(moved < 0.2 * sound.position_sigma)
    assert found.verdict.level == "DOUBT"
    assert f"{len(few)} of {len(log.pressure)} readings are corrupt" in str(found.verdict)


def patches(points, places, reach=6e-3):
    """Readings of taxels at `places` in contacts at `points`: contact, taxel, pressure."""
    distance = np.linalg.norm(points[:, None] - places, axis=2)
    contact, taxel = np.nonzero(distance < reach)
    return contact, taxel, 1.0 - (distance[contact, taxel] / reach) ** 2


@pytest.mark.parametrize("follows", [False, True])
def test_what_follows_a_press_is_no_spike(follows):
    """Creep in taps of a random order: a taxel still reads when another place is tapped."""
    rng = np.random.default_rng(1)
    points = 2e-3 * np.stack(np.meshgrid(range(30), range(30), [0]), axis=-1).reshape(-1, 3)
    points = rng.permutation(points)
    contact, taxel, pressure = patches(points, np.array([[0.01, 0.01, 0], [0.05, 0.05, 0]]))
    strong = contact[(taxel == 0) & (pressure > 0.8) & (contact < len(points) - 3)][0]
    far = np.linalg.norm(points - [0.01, 0.01, 0], axis=1) > 0.02
    after = strong + 1 if follows else np.flatnonzero(far & ~np.isin(np.arange(900), contact))[100]
    points[strong + 1] = [0.045, 0.03, 0] if follows else points[strong + 1]
    contact, taxel = np.append(contact, after), np.append(taxel, 0)
    found = spikes(np.append(pressure, 0.6), taxel, contact, points, 0.02, 6e-3)
    assert found.sum() == found[-1] == (not follows)


def test_a_second_place_is_no_spike():
    """Taxels 0 and 1 are short-circuited: each reads at two places, for many contacts."""
    points = 2e-3 * np.stack(np.meshgrid(range(30), range(30), [0]), axis=-1).reshape(-1, 3)
    contact, _, pressure = patches(points, np.array([[0.01, 0.01, 0], [0.05, 0.05, 0]]))
    found = spikes(pressure, np.zeros(len(contact), int), contact, points, 0.02, 6e-3)
    assert not found.any()


def test_sparse_contacts_confirm_nothing():
    points = 8e-3 * np.stack(np.meshgrid(range(20), range(20), [0]), axis=-1).reshape(-1, 3)
    contact, taxel, pressure = patches(points, points[[45, 46]] + 1e-3)
    contact, taxel = np.append(contact, 350), np.append(taxel, 0)
    assert not spikes(np.append(pressure, 1.0), taxel, contact, points, 0.02, 6e-3).any()


@pytest.mark.deep
@pytest.mark.parametrize("noise", [pytest.param(0.01, marks=pytest.mark.slow), None])
def test_frames_that_were_written_twice_count_once(world, recording, sound, noise):
    contacts, readings = recording.contacts, recording.readings
    times = recording.time[:, None] + [0.0, recording.frame / 2]
    frames = contacts.take(np.repeat(np.arange(len(contacts)), 2))
    rows = np.tile(np.arange(len(readings)), 2)
    at = times[recording.reading_contact[rows], np.repeat([0, 1], len(readings))]
    order = np.argsort(at, kind="stable")
    twice = replace(
        recording,
        contacts=frames.set_column(0, "time", pa.array(times.ravel())),
        readings=readings.take(rows[order]).set_column(0, "time", pa.array(at[order])),
    )
    found = calibrate(twice, world.belief(noise, 0.05))
    np.testing.assert_allclose(found.positions, sound[noise].positions, atol=1e-8)
    np.testing.assert_allclose(found.position_sigma, sound[noise].position_sigma, rtol=1e-4)
