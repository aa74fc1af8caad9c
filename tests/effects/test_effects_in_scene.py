"""Effects in a simulated scene: absent when off, alone when on, blind to batches, bounded."""

import functools
import subprocess
import sys

import numpy as np
import pytest

import meshskin as ms
from meshskin import effects
from meshskin.effects.frames import Frames
from meshskin.geometry.region import Cap
from meshskin.simulation import simulate
from meshskin.study.sensitivity.replay import Replay

DRAWING = ("gain_offset", "broken_taxels", "encoder", "force_sensor", "gaussian_noise")
OPTIONS = {
    "broken_taxels": {"dead": 0.1, "stuck": 0.1},
    "layer": {"thickness": 0.02},
    "disc_averaging": {"radius": 1e-3},
    "joint_friction": {"torque": 0.1},
}
SLOW = pytest.mark.slow
RECORDED = [k for k in effects.CLASS_NAMES if effects.find(k).stage in ("geometry", "robot")]
READ = [k for k in effects.CLASS_NAMES if k not in RECORDED]
IDLE = ("gaussian_noise", "elliptic_patch")
"""On in the scene without being asked for, and without anything to do on a sphere."""


@pytest.fixture(scope="module")
def small():
    """The noisy sphere with 19 taxels, which are soon explored."""
    scene = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(scene.body, spacing=5e-3, count=19, region=Cap((0.0, 0.0, -1.0)))
    return scene.with_(skin=skin)


@pytest.fixture(scope="module")
def plain(small):
    return ms.simulate(small, seed=1)


def make(name):
    """An effect at its defaults, but with enough broken taxels for 19, and what some need."""
    return effects.find(name)(**OPTIONS.get(name, {}))


def run(scene, *names):
    """The recording with more effects on."""
    return ms.simulate(scene.with_(effects=(*scene.effects, *map(make, names))), seed=1)


@pytest.fixture(scope="module")
def one(small):
    """one(name): the recording with this effect more, kept."""
    return functools.cache(lambda name: run(small, name))


def table(recording):
    """Readings by contact and taxel."""
    keys = zip(recording.reading_contact, recording.reading_taxel, strict=True)
    return dict(zip(keys, recording.pressure, strict=True))


def test_off_means_that_no_module_is_imported_and_nothing_acts():
    code = (
        "import sys, meshskin as ms; from meshskin import effects; "
        "s = ms.Scene.load('sphere'); field = lambda f, p: None; "
        "pipeline = effects.EffectPipeline.from_effects(s.effects, s.context(1), field); "
        "assert pipeline == effects.EffectPipeline((), field, (), (), effects.EffectClock()); "
        "names = [m for m in sys.modules if m.startswith('meshskin.effects.')]; "
        "names = {name.rpartition('.')[2] for name in names}; "
        "assert names == {'base', 'frames', 'pipeline', 'registry'}, names"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_off_again_means_the_same_bits(small, plain, one):
    """Effects that were on before, all of them imported and built, leave nothing behind."""
    for name in effects.CLASS_NAMES:
        if name != "gaussian_noise":
            one(name)
    again = ms.simulate(small, seed=1)
    for table_of in ("contacts", "readings", "motion"):
        assert getattr(again, table_of).equals(getattr(plain, table_of))


@pytest.mark.parametrize("name", RECORDED)
def test_what_is_recorded_leaves_the_readings_bit_for_bit(name, one, plain):
    other = one(name)
    assert other.readings.equals(plain.readings)
    assert not other.contacts.equals(plain.contacts)
    assert other.motion.equals(plain.motion)


@pytest.mark.parametrize("name", [k for k in READ if k not in IDLE])
def test_what_is_read_leaves_the_contacts_bit_for_bit(name, one, plain):
    other = one(name)
    assert other.contacts.equals(plain.contacts)
    assert not other.readings.equals(plain.readings)
    assert other.motion.equals(plain.motion)


@pytest.mark.parametrize("name", [k for k in DRAWING if k != "gaussian_noise"])
def test_toggling_one_leaves_the_noise_of_another(name, small):
    """The noise is what the noisy scene reads beyond the one without noise."""
    quiet = small.with_(effects=(), readout=ms.Readout(threshold_relative=1e-9))
    noisy = quiet.with_(effects=small.effects)
    without = table(ms.simulate(quiet, seed=1)), table(ms.simulate(noisy, seed=1))
    with_ = table(run(quiet, name)), table(run(noisy, name))
    live = without[0].keys() & without[1].keys() & with_[0].keys() & with_[1].keys()
    broken = make("broken_taxels").chosen(small.context(1))
    if name == "broken_taxels":
        ids = np.asarray(small.skin.ids)[np.concatenate(broken)]
        live = {key for key in live if key[1] not in ids}
    assert len(live) > 500
    alone, along = ([b[k] - a[k] for k in sorted(live)] for a, b in (without, with_))
    np.testing.assert_allclose(alone, along, atol=1e-9 * small.patch.peak)


def test_no_effect_depends_on_the_batches(small, monkeypatch):
    names = [k for k in effects.CLASS_NAMES if k not in (*IDLE, "cover_fabric")]  # slow, no state
    whole = run(small, *names)
    monkeypatch.setattr(simulate, "FRAME_CELLS", 19 * 40)
    parts = run(small, *names)
    for name in ("time", "points", "normals", "force"):
        np.testing.assert_allclose(
            getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-14
        )
    np.testing.assert_array_equal(parts.reading_taxel, whole.reading_taxel)
    np.testing.assert_allclose(parts.pressure, whole.pressure, rtol=1e-9)


def test_the_frames_of_a_scene_are_contacts_with_the_indenter(small):
    """Seen from an effect: the pose of the configuration puts the indenter where it stands."""
    seen: list[Frames] = []

    class Spy(effects.BaseEffect):
        name, stage, cost = "spy", "contact", 0.0

        def bound(self, context):
            return 0.0

        def build(self, context):
            def look(frames):
                seen.append((context, frames))
                return frames

            return look

    arm = small.with_(effects=(Spy(),))
    floating = arm.with_(loop=ms.scene.settings.Loop(mode="quasi_static"))
    for scene in (arm, floating):
        seen.clear()
        ms.simulate(scene, seed=1)
        for context, frames in seen:
            if len(frames):
                pose = context.pose(frames.q)
                world = np.einsum("kij,kj->ki", pose[:, :3, :3], frames.centres) + pose[:, :3, 3]
                np.testing.assert_allclose(world - context.indenter_position, 0.0, atol=1e-7)


@pytest.mark.parametrize("name", [k for k in effects.CLASS_NAMES if k not in IDLE])
def test_leaving_an_effect_out_costs_no_more_than_its_bound(name, small, one, plain):
    """The shift of the joint estimate that does not know of the effect; an estimate loses taxels
    to broken ones."""
    belief = small.belief()
    effect = make(name)
    before, after = (ms.calibrate(r, belief).positions for r in (plain, one(name)))
    shift = np.linalg.norm(after - before, axis=1)
    assert np.nanmax(shift) <= effect.bound(small.context(1))
    assert np.nanmax(shift) > 1e-7


@pytest.mark.parametrize(
    "name",
    ["small", *(pytest.param(n, marks=SLOW) for n in ("ellipsoid", "capsule", "torus"))],
)
def test_the_encoders_bound_is_near_what_encoders_do(name, small):
    """No seed's largest shift exceeds it, and the worst of six comes to more than a third."""
    scene = small if name == "small" else ms.Scene.load(name)
    encoder = effects.find("encoder")()
    belief, bound = scene.belief(), encoder.bound(scene.context(0))
    rehearsal, shifts = Replay.of(scene), []
    for seed in range(6):
        worlds = scene.effects, (*scene.effects, encoder)
        before, after = (
            ms.calibrate(rehearsal.recording(world, seed), belief).positions for world in worlds
        )
        shifts.append(np.nanmax(np.linalg.norm(after - before, axis=1)))
    assert bound / 3 < max(shifts) <= bound


def test_an_effect_can_stand_in_a_scene_file(tmp_path):
    file = tmp_path / "worn.toml"
    file.write_text(
        'extends = "sphere_noisy"\n[[effects]]\nkind = "friction"\ncoefficient = 0.3\n'
        '[[effects]]\nkind = "cover_fabric"\nwidth_mm = 0.5\n'
        '[[effects]]\nkind = "indenter_offset"\noffset_mm = [0.1, 0, 0]\n'
    )
    scene = ms.Scene.load(file)
    assert [e.name for e in scene.effects] == ["friction", "cover_fabric", "indenter_offset"]
    assert scene.effects[1].width == pytest.approx(5e-4)
    assert scene.effects[2].offset == pytest.approx((1e-4, 0.0, 0.0))
