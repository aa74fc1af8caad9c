"""A taxel whose gain changes in the course of a recording is not determined."""

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.estimation.learned.gain_changes import GAIN_CHANGES

from .test_contact_kinds import scattered


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_one_taxel_at_a_lower_gain_from_halfway_on(factor):
    """It is left out; the others, and all of a sound recording, are not."""
    scene, log = scattered(0)
    taxel = log.reading_taxel
    late = log.reading_contact >= len(log.points) // 2
    one = int(np.argmax(np.bincount(taxel[late])))
    changed = np.where(late & (taxel == one), factor, 1.0) * log.pressure
    index = log.readings.column_names.index("pressure")
    readings = log.readings.set_column(index, "pressure", pa.array(changed))
    belief = scene.belief(contact="learned", noise_sigma=None)
    found = ms.calibrate(ms.Recording(log.contacts, readings, {}), belief)
    left_out = found.ids[found.reasons == GAIN_CHANGES]
    assert left_out.tolist() == ([one] if factor < 1 else [])
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    assert np.nanmax(error) < 0.2e-3
