"""The map of a log: written and read back, field paths, and what it refuses."""

import numpy as np
import pytest

from meshskin.core.errors import MeshskinError
from meshskin.recording import field_path
from meshskin.recording.log_map import LogMap, StreamMap

MAP = LogMap(
    (
        StreamMap("/joint_states", "joints", unit="deg", names=("a", "b")),
        StreamMap(
            "/skin",
            "taxels",
            ("data",),
            unit="count",
            delay=0.037,
            ids=(3, 1, 2),
            polarity="falling",
        ),
        StreamMap("/tip", "pose", unit="mm", point=(0.0, 0.0, 0.004), axis=(0.0, 0.0, -1.0)),
        StreamMap("/skin2", "taxels", ("s[name=b].v",), unit="Pa", first_id=9, length=4, time="t"),
    )
)


def test_a_map_is_read_back_as_it_was_written(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(MAP.to_toml())
    assert LogMap.load(path) == MAP
    assert "delay_s = 0.037" in MAP.to_toml()
    path.write_text(MAP.to_toml().replace("delay_s = 0.037", "delay_ms = 37"))
    assert LogMap.load(path).streams[1].delay == pytest.approx(0.037)


def test_message_files_lie_beside_the_map(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text('messages = ["msg/Skin.msg"]\n[[stream]]\ntopic = "/s"\nkind = "taxels"\n')
    assert LogMap.load(path).messages == (tmp_path / "msg" / "Skin.msg",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the map names no stream"),
        ("[stream]\ntopic = '/s'", r"write \[\[stream\]\]"),
        ("[[stream]]\ntopic = '/s'", r"\[stream /s\] lacks kind"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxel'", "unknown kind of a stream 'taxel'; did"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxels'\ndelay = 3", "delay needs a unit in its"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxels'\nlenght = 3", "did you mean length"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxels'\nlength = 0", "length of /s .*at least 1"),
        ("[[stream]]\ntopic = '/s'\nkind = 'joints'\nunit = 'turns'", "unknown unit of joints"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxels'\nvalues = ['a..b']", "path must be names"),
        ("[[stream]]\ntopic = '/s'\nkind = 'taxels'\nvalues = 'a'", "values must be a list"),
        ("[[streams]]", "unknown key 'streams'.*did you mean stream"),
    ],
)  # fmt: skip
def test_bad_maps_are_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(MeshskinError, match=words) as error:
        LogMap.load(path)
    assert "\n" not in str(error.value)


MESSAGE = {
    "pads": [{"name": "a", "v": np.array([1.0, 2.0])}, {"name": "b", "v": np.array([3.0])}],
    "force": {"x": 4.0},
    "data": np.arange(6.0),
}


@pytest.mark.parametrize(
    ("path", "values"),
    [
        ("pads[].v", [1, 2, 3]),
        ("pads[1].v", [3]),
        ("pads[name=a].v", [1, 2]),
        ("pads[name=c].v", []),
        ("force.x", [4]),
        ("data[2::3]", [2, 5]),
        ("data[:2]", [0, 1]),
    ],
)
def test_field_paths(path, values):
    found = field_path.numbers(field_path.getter(path)(MESSAGE), path)
    np.testing.assert_array_equal(found, values)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("pads[].w", "unknown field 'w' in the field path pads"),
        ("pads[5].v", "shorter than its number, got 2 elements"),
        ("force[].x", "brackets .* belong to lists"),
        ("force.x.y", "nothing is below y"),
        ("pads[].name", "must contain numbers"),
        ("data[::0]", "field path must be names"),
    ],
)
def test_field_paths_that_lead_nowhere(path, words):
    with pytest.raises(MeshskinError, match=words):
        field_path.numbers(field_path.getter(path)(MESSAGE), path)


def test_numbers_of_unknown_messages_are_found():
    assert dict(field_path.numeric_paths(MESSAGE)) == {"pads[].v": 3, "force.x": 1, "data": 6}
