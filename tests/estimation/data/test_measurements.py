"""Measurements refuse recordings and beliefs that do not belong together."""

import re

import numpy as np
import pyarrow as pa
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation.data.measurements import gather
from meshskin.recording.recording import Recording


def scaled(recording, factor):
    contacts = recording.contacts
    for name in ("px", "py", "pz"):
        column = contacts.schema.get_field_index(name)
        values = pa.array(factor * contacts.column(name).to_numpy())
        contacts = contacts.set_column(column, name, values)
    return Recording(contacts, recording.readings, recording.metadata)


@pytest.mark.parametrize("factor", [1e-3, 1e3, 1e-6])
def test_a_wrong_unit_of_contact_points_is_named(world, factor):
    with pytest.raises(CalibrationError, match=re.escape(f"times {1 / factor:g} they are on it")):
        gather(scaled(world.record(), factor), world.belief())


def test_contact_points_of_another_frame_keep_the_general_remedy(world):
    with pytest.raises(CalibrationError, match="in the body's frame"):
        gather(scaled(world.record(), 3.0), world.belief())


def test_headings_must_be_one_for_each_contact(world):
    recording = world.record()
    few = np.broadcast_to(np.eye(3), (len(recording.time) - 1, 3, 3))
    with pytest.raises(CalibrationError, match=rf"one rotation .* got shape \({len(few)}, 3, 3\)"):
        gather(recording, world.belief(unknown=("indenter_offset",), headings=few))
