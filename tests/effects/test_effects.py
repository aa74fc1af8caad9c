"""The registry of effects: TOML tables, order, conflicts, random streams, other packages."""

import subprocess
import sys
import warnings
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from typing import ClassVar

import numpy as np
import pytest

import meshskin as ms
from meshskin import effects
from meshskin.core.errors import ConfigError, UnknownNameError
from meshskin.effects import registry
from meshskin.effects.gaussian_noise import GaussianNoise

NEEDED = {
    "layer": {"thickness_mm": 20},
    "disc_averaging": {"radius_mm": 1},
    "joint_friction": {"torque_n_m": 0.1},
}
"""Options of the effects without defaults."""


def test_noise_has_its_standard_deviation_and_zero_mean(context, glide):
    frames, sigma = glide(np.zeros(500)), 0.02 * context.peak_pressure
    noise = GaussianNoise(0.02).build(context)(np.full((500, 80), 1e4), frames) - 1e4
    assert noise.std() == pytest.approx(sigma, rel=0.02)
    assert abs(noise.mean()) < 4 * sigma / np.sqrt(noise.size)
    neighbours = np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1]
    assert abs(neighbours) < 0.02


def test_streams_differ_by_seed_and_by_name(context):
    first, again = context.stream("gaussian_noise"), context.stream("gaussian_noise")
    assert first.random() == again.random()
    others = [context.stream("hysteresis"), replace(context, seed=4).stream("gaussian_noise")]
    assert len({g.random() for g in (context.stream("gaussian_noise"), *others)}) == 3


def test_bound_grows_with_the_noise(context):
    assert GaussianNoise(0.01).bound(context) == pytest.approx(0.03 * context.contact_radius)


def test_effect_from_a_toml_table():
    found = effects.from_table({"kind": "gaussian_noise", "sigma_relative": 0.05})
    assert found == GaussianNoise(0.05)
    with pytest.raises(UnknownNameError, match="did you mean gaussian_noise"):
        effects.from_table({"kind": "gausian_noise"})
    with pytest.raises(UnknownNameError, match="sigma_relative"):
        effects.from_table({"kind": "gaussian_noise", "sigma": 0.05})
    with pytest.raises(ConfigError, match="limit: above 0"):
        effects.from_table({"kind": "gaussian_noise", "sigma_relative": -0.1})
    with pytest.raises(ConfigError, match="lacks kind"):
        effects.from_table({"sigma_relative": 0.1})


def test_only_the_given_stage_is_built(context):
    assert effects.build((), context, "transducer") == ()
    assert effects.build((GaussianNoise(),), context, "pressure") == ()
    assert len(effects.build((GaussianNoise(),), context, "transducer")) == 1


def test_conflicts_raise():
    class Drift(GaussianNoise):
        name, stage, requires = "drift", "robot", ("thermometer",)

    class Quiet(GaussianNoise):
        name, stage, excludes = "quiet", "geometry", ("gaussian_noise",)

    class Nowhere(GaussianNoise):
        name, stage = "nowhere", "robt"

    with pytest.raises(UnknownNameError, match=r"'robt' of the effect nowhere.*did you mean robot"):
        effects.ordered((Nowhere(),))
    with pytest.raises(ConfigError, match="2 times"):
        effects.ordered((GaussianNoise(), GaussianNoise(0.1)))
    with pytest.raises(ConfigError, match="requires thermometer"):
        effects.ordered((Drift(),))
    with pytest.raises(ConfigError, match="quiet excludes gaussian_noise"):
        effects.ordered((GaussianNoise(), Quiet()))


@dataclass(frozen=True)
class Blur(effects.BaseEffect):
    """An effect of another package whose field has the name of a method of NoiseEffect."""

    sigma: float = 1e-3
    name: ClassVar[str] = "blur"
    stage: ClassVar[str] = "transducer"
    cost: ClassVar[float] = 0.0

    def bound(self, context):
        return 0.0

    def build(self, context):
        return lambda pressures, frames: pressures


def test_an_effect_is_named_by_its_class_and_so_is_a_variant():
    class SlowEcho(effects.BaseEffect, stage="robot", cost=1e-9):
        pass

    class Variant(SlowEcho):
        stage = "geometry"

    class Named(SlowEcho, name="my_name"):
        pass

    @dataclass(frozen=True)
    class LouderNoise(GaussianNoise):
        pass

    assert Named.name == "my_name"
    assert (SlowEcho.name, SlowEcho.stage, SlowEcho.cost) == ("slow_echo", "robot", 1e-9)
    assert (Variant.name, Variant.stage, Variant.cost) == ("variant", "geometry", 1e-9)
    assert effects.find("louder_noise") is LouderNoise
    assert effects.find("gaussian_noise") is GaussianNoise


def test_an_effect_with_the_name_of_a_shipped_one_is_refused(sphere):
    """A table or a study would build the shipped one in its place."""
    with pytest.raises(ConfigError, match="an effect hysteresis exists in meshskin"):

        class Hysteresis(effects.BaseEffect, stage="transducer", cost=1e-9):
            pass

    class Plain:
        name, stage, cost = "crosstalk", "transducer", 0.0

        def bound(self, context):
            return 0.0

        def build(self, context):
            return lambda pressures, frames: pressures

    with pytest.raises(ConfigError, match=r"the class .*Plain of .*; rename the class"):
        sphere.with_(effects=(Plain(),))


def test_an_effect_without_a_stage_is_refused_by_name(sphere):
    @dataclass(frozen=True)
    class Nowhere(effects.BaseEffect):
        def bound(self, context):
            return 0.0

        def build(self, context):
            return None

    class Idle(effects.BaseEffect, stage="robot", cost=0.0):
        pass

    with pytest.raises(ConfigError, match="the effect nowhere has no stage"):
        sphere.with_(effects=(Nowhere(),))
    with pytest.raises(ConfigError, match="the effect idle has no bound and no build"):
        sphere.with_(effects=(Idle(),))


@pytest.mark.parametrize(
    ("stage", "returned", "value"),
    [
        ("transducer", lambda given, frames: given[:, :2], r"the shape \(3, 2\)"),
        ("pressure", lambda given, frames: given * np.nan, "240 that are not finite"),
        ("transducer", lambda given, frames: None, "None"),
        ("geometry", lambda frames: None, "None"),
        ("robot", lambda frames: frames.rows(slice(2)), "Frames"),
    ],
)
def test_what_an_effect_of_a_program_returns_is_checked(context, glide, stage, returned, value):
    """Readings of two taxels, or none at all, would pass for those of a skin."""

    @dataclass(frozen=True)
    class Mistaken(effects.BaseEffect, stage=stage, cost=0.0):
        returns: object = None

        def bound(self, context):
            return 0.0

        def build(self, context):
            return self.returns

    def act(returns):
        (made,) = effects.build((Mistaken(returns),), context, stage)
        frames = glide(np.zeros(3))
        given = (frames,) if stage in ("geometry", "robot") else (np.ones((3, 80)), frames)
        return made(*given), given[0]

    with pytest.raises(ConfigError, match=f"effect mistaken returns is unusable, got .*{value}"):
        act(returned)
    right, given = act(lambda given, *frames: given)
    assert right is given


def test_a_field_named_like_a_method_is_refused_by_name(sphere):
    for use in (lambda: sphere.with_(effects=(Blur(),)), lambda: effects.ordered((Blur(),))):
        with pytest.raises(ConfigError, match="sigma of the effect blur must be a method"):
            use()


@pytest.mark.parametrize("wrong", ["gaussian_noise", 3, GaussianNoise, object()])
def test_objects_that_are_not_effects_are_refused(sphere, wrong):
    with pytest.raises(ConfigError, match="must contain Effect objects") as caught:
        sphere.with_(effects=(wrong,))
    assert "\n" not in str(caught.value)


def test_effects_act_in_the_order_of_the_signal():
    class Late(GaussianNoise):
        name, stage = "late", "robot"

    class Foreign(effects.BaseEffect, stage="transducer", cost=0.0):
        def bound(self, context):
            return 0.0

        def build(self, context):
            return None

    inside = [
        effects.find(name)()
        for name in ("quantisation", "gaussian_noise", "hysteresis", "cover_fabric", "friction")
    ]
    assert [e.name for e in effects.ordered((Late(), Foreign(), *inside))] == [
        "friction",
        "cover_fabric",
        "hysteresis",
        "gaussian_noise",
        "quantisation",
        "foreign",
        "late",
    ]


def test_a_derived_effect_keeps_the_place_of_its_base():
    """Whatever its own name, and through classes between."""

    class WideCrosstalk(effects.find("crosstalk")):
        pass

    class WiderCrosstalk(WideCrosstalk):
        pass

    ends = effects.find("quantisation")(), effects.find("hysteresis")()
    for kind in (WideCrosstalk, WiderCrosstalk):
        found = effects.ordered((ends[0], kind(), ends[1]))
        assert [type(effect) for effect in found] == [kind, type(ends[1]), type(ends[0])]


@pytest.mark.parametrize("name", effects.NAMES)
def test_every_effect_has_the_interface(name, context):
    table = {"kind": name, **NEEDED.get(name, {})}
    effect = effects.from_table(table)
    assert effect.name == name
    assert effect.stage in effects.STAGES
    assert effect.requires == ()
    assert set(effect.excludes) <= set(effects.NAMES)
    assert 0 < effect.bound(context) < 0.1
    assert 0 < effect.cost < 1e-3
    assert len(effects.build((effect,), context, effect.stage)) == 1
    assert effects.from_table(table) == effect
    assert name in NEEDED or effect == effects.find(name)()
    assert not [
        e for e in effects.STAGES if e != effect.stage and effects.build((effect,), context, e)
    ]


def test_effects_without_defaults_are_not_registered(context):
    assert set(NEEDED) == set(effects.NAMES) - {e.name for e in effects.registered()}
    with pytest.raises(ConfigError, match="thickness"):
        effects.from_table({"kind": "layer"})


def test_registry_is_in_the_order_of_the_stages():
    stages = [effects.STAGES.index(effects.find(name).stage) for name in effects.NAMES]
    assert stages == sorted(stages)


TOY = """
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Toy:
    factor: float = 2.0
    name: ClassVar[str] = "toy"
    stage: ClassVar[str] = "transducer"
    requires: ClassVar[tuple[str, ...]] = ()
    excludes: ClassVar[tuple[str, ...]] = ()
    cost: ClassVar[float] = 1e-9

    def bound(self, context):
        return context.reading_error_bound(abs(self.factor - 1.0))

    def build(self, context):
        return lambda pressures, frames: self.factor * pressures


@dataclass(frozen=True)
class Blur(Toy):
    sigma: float = 1e-3
    name: ClassVar[str] = "blur"
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Another package with entry points, some of them broken."""
    (tmp_path / "toy_effects.py").write_text(TOY)
    info = tmp_path / "toy_effects-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-effects\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[meshskin.effects]\ntoy = toy_effects:Toy\nblur = toy_effects:Blur\n"
        "gone = toy_effects:Gone\nlost = no_such_module:Lost\nnumber = math:pi\n"
        "raising = raising_effects:Toy\n"
    )
    (tmp_path / "raising_effects.py").write_text("raise RuntimeError('no licence\\nfound')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("toy_effects", None)


def test_effect_of_another_package(toy, sphere):
    twice = effects.from_table({"kind": "toy", "factor": 3.0})
    assert "toy" not in effects.NAMES
    plain, found = (
        ms.press(scene, sphere.skin.positions[:5], seed=1)
        for scene in (sphere, sphere.with_(effects=(twice,)))
    )
    np.testing.assert_array_equal(found.pressure, 3.0 * plain.pressure)
    with pytest.raises(UnknownNameError, match="did you mean toy"):
        effects.find("toyy")


def test_an_effect_that_the_program_defines_is_found_by_its_name():
    """The class that was defined last, as in a notebook whose cell is run again."""

    def define(default):
        @dataclass(frozen=True)
        class LocalDoubling(effects.BaseEffect, stage="transducer", cost=1e-9):
            factor: float = default

        return LocalDoubling

    kept = [define(2.0), define(3.0)]
    assert effects.find("local_doubling") is kept[1]
    assert effects.from_table({"kind": "local_doubling"}).factor == 3.0
    with pytest.raises(UnknownNameError, match="did you mean local_doubling"):
        effects.find("local_dubling")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("gone", "cannot be loaded"),
        ("lost", "no_such_module"),
        ("number", "must be a dataclass"),
        ("raising", "RuntimeError: no licence found"),
    ],
)
def test_broken_entry_point_raises_an_error_of_one_line(toy, name, reason):
    with pytest.raises(ConfigError, match=reason) as caught:
        effects.find(name)
    assert "\n" not in str(caught.value)


def test_an_entry_point_whose_class_has_a_shipped_name_is_told_one_remedy(tmp_path, monkeypatch):
    text = "from meshskin.effects import BaseEffect\n\nclass Hysteresis(BaseEffect):\n    pass\n"
    (tmp_path / "taken_effects.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint("taken", "taken_effects:Hysteresis", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "_entry_points", lambda: {"taken": point})
    with pytest.raises(ConfigError) as caught:
        effects.find("taken")
    assert str(caught.value) == (
        "an effect hysteresis exists in meshskin, got the class Hysteresis of taken_effects; "
        "rename the class"
    )


def test_broken_entry_points_are_left_out_with_a_warning(toy):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = [effect.name for effect in effects.registered()]
    assert found[-1] == "toy"
    assert "gaussian_noise" in found
    messages = [str(w.message) for w in caught]
    assert "sigma of the effect blur must be a method" in messages[0]
    assert [line.split()[2] for line in messages[1:]] == ["gone", "lost", "number", "raising"]
    assert all("it is left out" in line and "\n" not in line for line in messages)


def test_effect_of_a_missing_package_is_unknown():
    with pytest.raises(UnknownNameError, match=r"unknown effect 'toy' \(its package .*entry point"):
        effects.find("toy")


def test_modules_are_imported_only_when_named():
    code = (
        "import sys; from meshskin import effects; "
        "name = 'meshskin.effects.gaussian_noise'; assert name not in sys.modules; "
        "effects.find('gaussian_noise'); assert name in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
