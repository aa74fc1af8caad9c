"""Single readings that no contact explains cost no more than themselves."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.estimation.calibrate import calibrate


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
    assert "1 corrupt or negative readings left out" in found.faults[k]
    assert sum(map(bool, found.faults)) == 1
    assert found.readings[k] == sound.readings[k] - 1
