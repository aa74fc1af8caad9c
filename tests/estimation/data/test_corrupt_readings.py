"""Single readings that no contact explains cost no more than themselves."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.unit_checks import stuck_readings
from meshskin.recording.recording import READINGS, Recording


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
    index = recording.readings.column_names.index("pressure")
    return replace(
        recording, readings=recording.readings.set_column(index, "pressure", pa.array(pressure))
    )


@pytest.mark.parametrize("noise", [0.01, None])
@pytest.mark.parametrize("value", [38, 330, 1e5, 1e95, np.inf, np.nan, -1.0])
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
    table = pa.table([c[order] for c in columns], schema=READINGS)
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
    return Recording(contacts, pa.table(columns, schema=READINGS), {})


def corrupt(world, recording):
    """Taxels, rows, of the readings that are left out."""
    return gather(recording, world.belief()).corrupt[:, 1]


def middle_first(world, recording):
    """Contacts: most of them in the middle of the skin, then all."""
    apart = np.linalg.norm(world.points - world.points.mean(axis=0), axis=1)
    return np.concatenate([np.tile(np.argsort(apart)[:60], 50), np.arange(len(apart))])


def test_a_level_at_rest_is_not_stuck(world, recording):
    assert not len(corrupt(world, counted(world, recording, middle_first(world, recording))))


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
