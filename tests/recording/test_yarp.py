"""Folders of the YARP data dumper: joints, skin ports, and a real recording of skin contacts."""

import numpy as np
import pytest

from meshskin.core.errors import RecordingError, UnknownNameError
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_and_suggest, read_log
from meshskin.recording.resample import log_frames
from meshskin.recording.tare import tare

from ..real_data import DATA

needs_recording = pytest.mark.skipif(
    not (DATA / "icub_recording").is_dir(), reason="no icub_recording in DATA"
)
TIMES = 10 + np.arange(40) / 50


def port(folder, name, rows, stamps="rx"):
    """A folder as the dumper writes it."""
    folder.mkdir(parents=True)
    info = (
        f"Type: Bottle;\nStamp: {stamps};\n[9.5] {name} [connected]\n[12.0] {name} [disconnected]\n"
    )
    (folder / "info.log").write_text(info)
    lines = []
    for k, (time, row) in enumerate(zip(TIMES, rows, strict=True)):
        received = f"{time + 0.5:.6f} " if stamps == "tx+rx" else ""
        lines.append(f"{k} {time:.6f} {received}{row}\n")
    (folder / "data.log").write_text("".join(lines))


@pytest.fixture
def dump(tmp_path):
    """Joints of an arm and of the torso, and 12 raw taxels."""
    rng = np.random.default_rng(1)
    values = {
        "arm": rng.uniform(-90, 90, (40, 16)).round(3),
        "torso": rng.uniform(-9, 9, (40, 3)).round(3),
        "skin": rng.integers(200, 255, (40, 12)),
    }
    names = {
        "arm": "/icub/left_arm/state:o",
        "torso": "/icub/torso/state:o",
        "skin": "/icub/skin/left_hand",
    }
    for part, rows in values.items():
        texts = [" ".join(map(str, row)) for row in rows]
        port(tmp_path / "dump" / part, names[part], texts, "tx+rx" if part == "torso" else "rx")
    return tmp_path / "dump", values


def test_ports_are_known_by_their_names(dump):
    log, could = read_and_suggest(dump[0])
    assert [s.name for s in log.streams] == [
        "/icub/left_arm/state:o", "/icub/skin/left_hand", "/icub/torso/state:o",
    ]  # fmt: skip
    arm, skin, torso = (could[s.name][0] for s in log.streams)
    assert (arm.kind, arm.unit, arm.names[3]) == ("joints", "deg", "l_elbow")
    assert (torso.kind, torso.names) == ("joints", ("torso_yaw", "torso_roll", "torso_pitch"))
    assert (skin.kind, skin.length, skin.polarity) == ("taxels", 12, "falling")


def test_values_and_times_of_the_sender(dump):
    could = read_and_suggest(dump[0])[1]
    log = read_log(dump[0], LogMap(tuple(one for (one,) in could.values())))
    for name, part in (("left_arm", "arm"), ("torso", "torso")):
        np.testing.assert_array_equal(log[f"/icub/{name}/state:o"].values, dump[1][part])
    np.testing.assert_array_equal(log["/icub/skin/left_hand"].values, dump[1]["skin"])
    for stream in log.streams:
        np.testing.assert_allclose(stream.times, TIMES, atol=1e-6)


def test_a_torn_last_line_is_left_out(dump):
    file = dump[0] / "skin" / "data.log"
    file.write_text(file.read_text()[:-9])
    log = read_log(dump[0], LogMap((StreamMap("/icub/skin/left_hand", "taxels"),)))
    np.testing.assert_array_equal(log.streams[0].values, dump[1]["skin"][:-1])
    assert len(log.notes) == 1
    assert "last line" in log.notes[0]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("5 10.1 1 2 3", "line 6 of skin/data.log .*3 values, 12 before"),
        ("5 10.1 ((1 2", "line 6 .* parentheses do not match"),
        ("5 10.1 ((1 2) (3))", "it is not a skin contact"),
        ("5 10.1 (1 2 3)", "it is not a skin contact"),
        ("hello", "line 6 .*must begin with a number and 1 time, got 'hello"),
    ],
)
def test_damage_in_the_middle_is_refused(dump, row, words):
    file = dump[0] / "skin" / "data.log"
    lines = file.read_text().splitlines(keepends=True)
    lines[5] = f"{row}\n"
    file.write_text("".join(lines))
    with pytest.raises(RecordingError, match=words):
        read_log(dump[0])


@pytest.mark.parametrize(
    ("stream", "kind", "words"),
    [
        (StreamMap("/icub/left_arm/stat", "joints"), UnknownNameError, "did you mean /icub/left"),
        (StreamMap("/icub/torso/state:o", "contacts"), RecordingError, "wrong type for contacts"),
        (StreamMap("/icub/torso/state:o", "joints", names=("a",)), RecordingError, "got 1 names"),
    ],
)  # fmt: skip
def test_ports_that_are_not_as_the_map_says_are_refused(dump, stream, kind, words):
    with pytest.raises(kind, match=words):
        read_log(dump[0], LogMap((stream,)))


def test_the_nearest_port_is_named_beside_ports_that_are_there(dump):
    streams = StreamMap("/icub/torso/state:o", "joints"), StreamMap("/icub/skn/left_hand", "taxels")
    with pytest.raises(UnknownNameError, match="did you mean /icub/skin/left_hand"):
        read_log(dump[0], LogMap(streams))


def test_ports_of_text_are_left_out_of_the_list(dump):
    port(dump[0] / "said", "/speech:o", ['"hello" [ok]'] * 40)
    log, _ = read_and_suggest(dump[0])
    assert len(log.streams) == 3
    assert "/speech:o is not listed: line 1 of said" in log.notes[0]
    with pytest.raises(RecordingError, match=r"line 1 of said/data.log .*read a port of vectors"):
        read_log(dump[0], LogMap((StreamMap("/speech:o", "taxels"),)))


def test_numbers_in_nested_lists_and_lines_without_any(dump):
    """State and force ports of YARP 3."""
    rows = dump[1]["arm"]
    states = ["({}) 5 ({}) 5".format(*[" ".join(map(str, row))] * 2) for row in rows]
    port(dump[0] / "state", "/icub/left_arm/stateExt:o", states)
    forces = [f"() () ((({k} 1 2 3 4 5) 9.5)) ()" if k else "" for k in range(40)]
    port(dump[0] / "ft", "/icub/left_arm/FT", forces)
    port(dump[0] / "none", "/icub/left_leg/state:o", [""] * 40)
    could = read_and_suggest(dump[0])[1]
    assert could["/icub/left_leg/state:o"] == []
    maps = [could[name][0] for name in ("/icub/left_arm/stateExt:o", "/icub/left_arm/FT")]
    log = read_log(dump[0], LogMap(tuple(maps)))
    joints, wrench = log.streams
    np.testing.assert_array_equal(joints.values, rows)
    assert (joints.fields[3], joints.unit) == ("l_elbow", "deg")
    np.testing.assert_array_equal(wrench.values[:, 0], np.arange(1, 40))
    np.testing.assert_array_equal(wrench.times, TIMES[1:])
    assert log.notes == ("1 lines of /icub/left_arm/FT are empty: they are left out",)


@needs_recording
def test_the_contacts_of_a_real_recording():
    """Counts by an independent reading of the text: one `((` or `) (` + four integers a contact."""
    import re

    text = (DATA / "icub_recording" / "data.log").read_text()
    parts = [int(m) for m in re.findall(r"\(\d+ \d+ \d+ (\d+)\) \(", text)]
    log = read_log(DATA / "icub_recording")
    port = "/skinManager/skin_events:o"
    names = {1: "left_hand", 2: "left_forearm", 4: "right_hand", 5: "right_forearm", 7: "torso"}
    for part, name in names.items():
        assert len(log[f"{port}/{name}"]) == parts.count(part)
    assert len(parts) == 2762
    assert all(len(s) == text.count("\n") for s in log.streams if s.name.endswith("taxels"))
    assert log.notes == ()


@needs_recording
def test_taxels_of_a_real_recording_are_in_contact_when_they_are_active():
    port = "/skinManager/skin_events:o/left_forearm"
    maps = (StreamMap(port, "contacts"), StreamMap(f"{port}/taxels", "taxels"))
    log = read_log(DATA / "icub_recording", LogMap(maps))
    contacts, taxels = log.streams
    first = contacts.values[0]
    assert contacts.fields == ("px", "py", "pz", "nx", "ny", "nz", "force", "pressure")
    assert np.linalg.norm(first[3:6]) == pytest.approx(1, abs=1e-2)
    active = taxels.values.max(axis=1) > 0
    assert np.isin(taxels.times[active], contacts.times).all()
    found = tare(taxels.times, taxels.values)
    assert not found.falling
    assert np.mean(found.in_contact == active) > 0.998
    (note,) = log_frames(log, LogMap(maps)).notes
    assert "computed by the robot from its own map of the taxels" in note
