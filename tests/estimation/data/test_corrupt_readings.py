"""Single readings that no contact explains cost no more than themselves."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.recording.recording import READINGS


@pytest.fixture(scope="module")
def recording(world):
    return world.record(0.01, 0.05)


def with_pressure(recording, row, value):
    pressure = recording.pressure.copy()
    pressure[row] = value
    index = recording.readings.column_names.index("pressure")
    return replace(
        recording, readings=recording.readings.set_column(index, "pressure", pa.array(pressure))
    )


@pytest.mark.parametrize("noise", [0.01, None])
@pytest.mark.parametrize("value", [38, 330, 1e5, 1e95, np.inf, np.nan, -1.0])
def test_one_corrupt_reading_costs_itself(world, recording, noise, value):
    belief = world.belief(noise, 0.05)
    row = int(np.argmax(recording.pressure))
    sound = calibrate(recording, belief)
    found = calibrate(with_pressure(recording, row, value * world.peak_reference), belief)
    moved = np.linalg.norm(found.positions - sound.positions, axis=1)
    assert np.all(moved < sound.position_sigma)
    k = int(np.flatnonzero(found.ids == recording.reading_taxel[row])[0])
    assert "1 corrupt, stuck or negative readings left out" in found.faults[k]
    assert sum(map(bool, found.faults)) == 1
    assert found.readings[k] == sound.readings[k] - 1


def test_a_stretch_of_one_value_over_the_skin_is_left_out(world, recording):
    belief = world.belief(None, 0.05)
    sound = calibrate(recording, belief)
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
