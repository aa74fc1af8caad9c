"""TOML tables become dataclasses, with units, bounds and nearest names."""

import math
from dataclasses import dataclass

import pytest

from meshskin.core import config
from meshskin.core.errors import ConfigError, MeshskinError, UnknownNameError
from meshskin.scene.scene import Scene


@dataclass(frozen=True)
class Example:
    radius: float = config.quantity("m", above=0.0)
    place: tuple[float, ...] = config.quantity("m", (0.0, 0.0))
    angle: float = config.quantity("rad", 0.0, most=math.pi)
    centre: tuple[float, float, float] = config.quantity("m", (0.0, 0.0, 0.0))
    spots: int | None = config.quantity("", None, least=1)
    colour: str = "red"

    def __post_init__(self) -> None:
        config.check_fields(self)


def test_units_are_converted():
    ball = config.from_table(
        Example, {"radius_mm": 100, "place_um": [1, 2e6], "angle_deg": 90}, "ball"
    )
    assert ball == Example(0.1, (1e-6, 2.0), math.pi / 2)


@pytest.mark.parametrize(
    ("table", "error", "message"),
    [
        ({"radius": 1}, ConfigError, "needs a unit .* radius_m, radius_mm"),
        ({"radus_mm": 1}, UnknownNameError, "did you mean radius_mm"),
        ({"radius_mm": -1}, ConfigError, "got -0.001 m, limit: above 0 m"),
        ({"radius_mm": math.nan}, ConfigError, "finite number, got nan"),
        ({"radius_mm": "1"}, ConfigError, "must be a number, got '1'"),
        ({"radius_mm": 1, "radius_m": 1}, ConfigError, "given twice"),
        ({"radius_mm": 1, "angle_deg": 200}, ConfigError, "at most 3.14159 rad"),
        ({}, ConfigError, "lacks radius; add radius_m or radius_mm"),
        (
            {"radius_m": [1, 2]},
            ConfigError,
            r"example.radius must be a finite number, got \(1, 2\)",
        ),
        ({"radius_m": 1, "centre_m": 2}, ConfigError, "must be a tuple of 3 numbers, got 2"),
        ({"radius_m": 1, "centre_m": [1, 2]}, ConfigError, "of 3 numbers, got \\(1, 2\\)"),
        ({"radius_m": 1, "place_m": 2}, ConfigError, "must be a tuple of numbers, got 2"),
        ({"radius_m": 1, "spots": 8.5}, ConfigError, "spots must be an integer, got 8.5"),
    ],
)
def test_a_wrong_value_is_named_with_its_limit(table, error, message):
    with pytest.raises(error, match=message):
        config.from_table(Example, table, "ball")


def test_invalid_toml_is_refused_with_its_line(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text("[body]\nradius_mm = \n")
    with pytest.raises(ConfigError, match=r"x.toml is not valid TOML.*line 2"):
        config.read_toml(file)


def test_tables_are_merged_by_key():
    assert config.merge({"a": {"x": 1, "y": 2}, "b": 3}, {"a": {"y": 4}}) == {
        "a": {"x": 1, "y": 4},
        "b": 3,
    }


def test_merge_lets_another_unit_replace_a_quantity():
    assert config.merge({"radius_mm": 1, "rate_hz": 2}, {"radius_m": 3}) == {
        "radius_m": 3,
        "rate_hz": 2,
    }


def test_errors_name_the_table_of_the_file(tmp_path):
    wrong = {"[arm]\npayload_kg = -1": "arm.payload is out of range"}
    wrong['[[effects]]\nkind = "gaussian_noise"\nsigma_relative = -1'] = (
        "gaussian_noise.sigma_relative is out of range"
    )
    for text, words in wrong.items():
        (tmp_path / "wrong.toml").write_text(f'extends = "sphere"\n{text}')
        with pytest.raises(ConfigError, match=f"^{words}"):
            Scene.load(tmp_path / "wrong.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm = 3", r"arm must be a table, got 3; write \[arm\]"),
        ("skin = 'a'", r"skin must be a table, got 'a'; write \[skin\]"),
        ("law = [[1]]", "law must be a table"),
        ("[arm]\nurdf = 1.5", "arm.urdf must be text in quotes, got 1.5"),
        ("[arm]\nfolders = [1]", "arm.folders must be a list, each of them text in quotes"),
        ("[skin]\nfile = inf", "skin.file must be text in quotes, got inf"),
        ("[body]\nshape = [1, 2]", r"unknown shape '\(1, 2\)'|unknown shape \[1, 2\]"),
        ("contact = false", "scene.contact must be text in quotes, got False"),
        ("effects = [1, 2]", r"effects must be a list of tables, got \[1, 2\]; write \[\[effects"),
        ("effects = 3", "effects must be a list of tables, got 3"),
        ("effects = 'auto'\ncandidates = 3", "candidates must be a list of tables, got 3"),
        ("[skin]\ncount = 1000000000000000000000000000000", "at most 1e.06"),
        ("[indenter]\nradius_mm = 1e-300", "limit: at least 0.0001 m"),
        ("[loop]\nintegrator = 4", "loop.integrator must be text in quotes, got 4"),
    ],
)
def test_values_of_a_wrong_type_are_refused(tmp_path, text, message):
    (tmp_path / "wrong.toml").write_text(f'extends = "sphere"\n{text}')
    with pytest.raises(MeshskinError, match=message):
        Scene.load(tmp_path / "wrong.toml")


@pytest.mark.parametrize("parent", ["3", "[1]", "nan", "'nope'"])
def test_an_unknown_parent_is_refused(tmp_path, parent):
    (tmp_path / "wrong.toml").write_text(f"extends = {parent}\n")
    with pytest.raises(ConfigError, match=r"unknown scene 'nope'|name or its TOML file, got"):
        Scene.load(tmp_path / "wrong.toml")
