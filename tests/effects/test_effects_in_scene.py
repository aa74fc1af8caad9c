"""Effects in a simulated scene: absent when off, independent, batched, below their bounds."""

import functools
import subprocess
import sys
from dataclasses import replace

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
    "broken_taxels": {"dead": 0.2, "stuck": 0.1},
    "layer": {"thickness": 0.02},
    "disc_averaging": {"radius": 1e-3},
    "joint_friction": {"torque": 0.1},
    "sampling": {"rate": 20.0},
}
SLOW = pytest.mark.slow
RECORDED = [k for k in effects.NAMES if effects.find(k).stage in ("geometry", "robot")]
READ = [k for k in effects.NAMES if k not in RECORDED]
IDLE = ("gaussian_noise", "elliptic_patch")
"""Effects that are on in the scene, or change nothing on a sphere."""


@pytest.fixture(scope="module")
def small():
    """The noisy sphere with 12 taxels, read at 50 Hz, which takes 0.2 s to explore."""
    scene = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(scene.body, spacing=5e-3, count=12, region=Cap((0.0, 0.0, -1.0)))
    return scene.with_(skin=skin, readout=replace(scene.readout, rate=50.0))


@pytest.fixture(scope="module")
def plain(small):
    return ms.simulate(small, seed=1)


def make(name):
    """An effect with its defaults, or OPTIONS where these do not show with 12 taxels at 50 Hz."""
    return effects.find(name)(**OPTIONS.get(name, {}))


def run(scene, *names):
    """The recording with additional effects."""
    return ms.simulate(scene.with_(effects=(*scene.effects, *map(make, names))), seed=1)


@pytest.fixture(scope="module")
def one(small):
    """one(name): the recording with this additional effect, cached."""
    return functools.cache(lambda name: run(small, name))


def table(recording):
    """Readings (Pa) by contact and taxel."""
    keys = zip(recording.reading_contact, recording.reading_taxel, strict=True)
    return dict(zip(keys, recording.pressure, strict=True))


@pytest.mark.deep
def test_modules_of_effects_that_are_off_are_not_imported():
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


@pytest.mark.slow
def test_effects_switched_off_again_leave_the_recording_bit_for_bit(small, plain):
    """After a simulation with all effects that can be on together."""
    run(small, *(name for name in effects.NAMES if name not in IDLE))
    again = ms.simulate(small, seed=1)
    for table_of in ("contacts", "readings", "motion"):
        assert getattr(again, table_of).equals(getattr(plain, table_of))


@pytest.mark.deep
@pytest.mark.parametrize("name", RECORDED)
def test_effects_on_recorded_contacts_leave_the_readings_bit_for_bit(name, one, plain):
    other = one(name)
    assert other.readings.equals(plain.readings)
    assert not other.contacts.equals(plain.contacts)
    assert other.motion.equals(plain.motion)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(k, marks=() if k in ("gain_offset", "hysteresis") else pytest.mark.deep)
        for k in READ
        if k not in IDLE
    ],
)
def test_effects_on_readings_leave_the_contacts_bit_for_bit(name, one, plain):
    other = one(name)
    assert other.contacts.equals(plain.contacts)
    assert not other.readings.equals(plain.readings)
    assert other.motion.equals(plain.motion)


@pytest.fixture(scope="module")
def quiet_and_noisy(small):
    """The scene without and with noise, at a threshold of almost zero, and the readings of both."""
    quiet = small.with_(effects=(), readout=ms.Readout(threshold_relative=1e-9))
    scenes = quiet, quiet.with_(effects=small.effects)
    return scenes, [table(ms.simulate(scene, seed=1)) for scene in scenes]


@pytest.mark.deep
@pytest.mark.parametrize("name", [k for k in DRAWING if k != "gaussian_noise"])
def test_switching_an_effect_leaves_the_noise_of_another(name, small, quiet_and_noisy):
    """The noise is the difference of the readings of the scenes with and without noise."""
    scenes, without = quiet_and_noisy
    with_ = [table(run(scene, name)) for scene in scenes]
    live = without[0].keys() & without[1].keys() & with_[0].keys() & with_[1].keys()
    broken = make("broken_taxels").chosen(small.context(1))
    if name == "broken_taxels":
        ids = np.asarray(small.skin.ids)[np.concatenate(broken)]
        live = {key for key in live if key[1] not in ids}
    assert len(live) > 500
    alone, along = ([b[k] - a[k] for k in sorted(live)] for a, b in (without, with_))
    np.testing.assert_allclose(alone, along, atol=1e-9 * small.patch.peak)


@pytest.mark.slow
def test_no_effect_depends_on_the_batches(small, monkeypatch):
    names = [
        k for k in effects.NAMES if k not in (*IDLE, "cover_fabric")
    ]  # the cover is slow and stateless
    whole = run(small, *names)
    monkeypatch.setattr(simulate, "FRAME_CELLS", 12 * 40)
    parts = run(small, *names)
    for name in ("time", "points", "normals", "force"):
        np.testing.assert_allclose(
            getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-14
        )
    np.testing.assert_array_equal(parts.reading_taxel, whole.reading_taxel)
    np.testing.assert_allclose(parts.pressure, whole.pressure, rtol=1e-9)


@pytest.mark.deep
def test_a_sample_that_is_held_keeps_all_that_the_robot_recorded(small):
    """Heading and force, with the noise of that sample: it is one measurement, not several."""
    held = run(small, "encoder", "force_sensor", "sampling")
    same = (np.diff(held.points, axis=0) == 0.0).all(axis=1)
    assert 0.2 < same.mean() < 0.9
    assert np.abs(np.diff(held.force))[same].max() == 0.0
    turns = np.abs(np.diff(held.headings, axis=0)).max(axis=(1, 2))
    assert turns[same].max() < 1e-12 < turns[~same].min()


@pytest.mark.deep
def test_encoders_turn_the_recorded_heading(one, plain):
    turn = np.einsum("kji,kjl->kil", plain.headings, one("encoder").headings)
    angle = np.linalg.norm(turn - np.swapaxes(turn, 1, 2), axis=(1, 2)) / np.sqrt(8.0)
    assert 1e-4 < np.sqrt(np.mean(angle**2)) < 2e-3  # six joints with offsets of 2e-4 rad


@pytest.mark.deep
def test_the_frames_of_a_scene_are_contacts_with_the_indenter(small):
    """The pose of each frame's configuration maps its centre to the position of the indenter."""
    seen: list[Frames] = []

    class Probe(effects.BaseEffect):
        name, stage, cost = "probe", "contact", 0.0

        def bound(self, context):
            return 0.0

        def build(self, context):
            def record(frames):
                seen.append((context, frames))
                return frames

            return record

    arm = small.with_(effects=(Probe(),))
    floating = arm.with_(loop=ms.scene.settings.Loop(mode="quasi_static"))
    for scene in (arm, floating):
        seen.clear()
        ms.simulate(scene, seed=1)
        for context, frames in seen:
            if len(frames):
                pose = context.pose(frames.q)
                world = np.einsum("kij,kj->ki", pose[:, :3, :3], frames.centres) + pose[:, :3, 3]
                np.testing.assert_allclose(world - context.indenter_position, 0.0, atol=1e-7)


@pytest.fixture(scope="module")
def calibrated(small, plain):
    return ms.calibrate(plain, small.belief()).positions


@pytest.mark.deep
@pytest.mark.parametrize("name", [k for k in effects.NAMES if k not in IDLE])
def test_ignoring_an_effect_shifts_taxels_by_less_than_its_bound(name, small, one, calibrated):
    """The shift of the joint estimate that ignores the effect; broken taxels may be missing."""
    effect = make(name)
    after = ms.calibrate(one(name), small.belief()).positions
    shift = np.linalg.norm(after - calibrated, axis=1)
    assert np.nanmax(shift) <= effect.bound(small.context(1))
    assert np.nanmax(shift) > 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small", "ellipsoid", "capsule", "torus"])
def test_bound_of_encoder_is_near_the_shift_that_it_causes(name, small):
    """The largest shift of six seeds lies between a third of the bound and the bound."""
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


def test_effects_are_read_from_a_scene_file(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(
        'extends = "sphere_noisy"\n[[effects]]\nkind = "friction"\ncoefficient = 0.3\n'
        '[[effects]]\nkind = "cover_fabric"\nwidth_mm = 0.5\n'
        '[[effects]]\nkind = "indenter_offset"\noffset_mm = [0.1, 0, 0]\n'
    )
    scene = ms.Scene.load(file)
    assert [e.name for e in scene.effects] == ["friction", "cover_fabric", "indenter_offset"]
    assert scene.effects[1].width == pytest.approx(5e-4)
    assert scene.effects[2].offset == pytest.approx((1e-4, 0.0, 0.0))
