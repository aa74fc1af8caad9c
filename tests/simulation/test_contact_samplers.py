"""Contact samplers: settled contacts of a recording; taxel ids of any size."""

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.recording.recording import Recording
from meshskin.simulation.contact_samplers import concatenate, settled_contacts
from meshskin.simulation.static_contacts import PRESS_INTERVAL, press


def recorded(times, phases):
    """A recording with contacts at `times` (steps of 1 s) of a motion with these phases."""
    times = np.asarray(times, dtype=float)
    flat = {name: np.zeros(len(times)) for name in ("px", "py", "pz", "nx", "ny", "nz", "force")}
    contacts = pa.table({"time": times, **flat})
    readings = pa.table(
        {"time": times, "taxel": np.zeros(len(times), np.int32), "pressure": np.ones(len(times))}
    )
    motion = pa.table({"time": np.arange(len(phases), dtype=float), "phase": phases})
    return Recording(contacts, readings, {"taxel_ids": [0]}, motion)


PHASES = ["approach", "slide", "slide", "next", "slide", "slide", "next", "slide"]


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        ([1, 2, 4, 5, 7], [2, 5, 7]),
        ([4, 5, 7], [5, 7]),  # no valid frame in the first touch
        ([1, 2, 7], [2, 7]),  # none in the second
        ([0, 3], []),  # none at all
    ],
)
def test_a_touch_without_a_valid_frame_is_left_out(times, kept):
    found = settled_contacts(recorded(times, PHASES))
    assert found.time.tolist() == kept
    assert found.readings.column("time").to_pylist() == kept


def test_settled_contacts_need_the_motion():
    whole = recorded([1, 2], PHASES)
    with pytest.raises(CalibrationError, match="no phases"):
        settled_contacts(Recording(whole.contacts, whole.readings, whole.metadata))


def test_concatenated_recordings_are_an_interval_apart():
    twice = concatenate(recorded([1, 2], PHASES), recorded([4, 5], PHASES))
    assert twice.time.tolist() == [1, 2, 2 + PRESS_INTERVAL, 3 + PRESS_INTERVAL]
    one, none = recorded([4, 5], PHASES), recorded([], PHASES)
    assert concatenate(none, one).time.tolist() == concatenate(one, none).time.tolist() == [4, 5]


@pytest.mark.parametrize("first", [7, 2**31 - 1, 2**40, -(2**33)])
def test_taxel_ids_of_64_bits_survive_recording_and_calibration(sphere, first, tmp_path):
    skin = sphere.skin
    scene = sphere.with_(skin=ms.Skin(skin.poses, first + np.arange(len(skin)), skin.disc_radius))
    press(scene, skin.positions).save(tmp_path / "r")
    recording = Recording.load(tmp_path / "r")
    assert set(recording.reading_taxel) == set(scene.skin.ids)
    found = ms.calibrate(recording, scene.belief())
    assert np.array_equal(found.ids, scene.skin.ids)
    assert found.touched.all()
