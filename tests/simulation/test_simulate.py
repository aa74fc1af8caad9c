"""The simulated exploration: force, coverage, noise, streaming, and named failures."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError, SimulationError, SkinError
from meshskin.core.se3 import transform
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.simulation.response import force_response


@pytest.fixture(scope="module")
def few(noisy):
    """The noisy scene on wide lanes: a third of its contacts."""
    return noisy.with_(exploration=replace(noisy.exploration, lane_spacing=0.012))


def motion(recording, name):
    return recording.motion.column(name).to_numpy()


def test_the_force_settles_on_its_reference_and_contact_is_never_lost(recording):
    got = force_response(motion(recording, "time"), motion(recording, "force"), 3.0)
    assert got.mean == pytest.approx(3.0, rel=0.01)
    assert got.std < 0.01
    assert got.lost == 0
    assert got.settling < 0.1
    assert got.overshoot < 0.02


def test_every_taxel_is_read_from_contacts_that_are_not_near_a_line(sphere, recording):
    for taxel in sphere.skin.ids:
        rows = np.unique(recording.reading_contact[recording.reading_taxel == taxel])
        points = recording.points[rows]
        apart = np.unique(np.round(points, 4), axis=0)
        assert len(apart) >= 4
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(rows))
        assert spread[1] > 1e-3


def test_contacts_lie_on_the_sphere(recording):
    np.testing.assert_allclose(np.linalg.norm(recording.points, axis=1), 0.1, atol=1e-7)
    cosine = np.einsum("ij,ij->i", recording.points, recording.normals) / 0.1
    np.testing.assert_allclose(cosine, 1.0, atol=1e-9)


@pytest.mark.deep
def test_the_same_seed_gives_the_same_recording(few):
    first, again, other = (ms.simulate(few, seed) for seed in (1, 1, 2))
    assert again.contacts.equals(first.contacts)
    assert again.readings.equals(first.readings)
    assert other.contacts.equals(first.contacts)
    assert not other.readings.equals(first.readings)


def test_noise_has_its_sigma_and_the_threshold_holds(noisy, recording, noisy_recording):
    keys = [
        dict(zip(zip(r.reading_contact, r.reading_taxel, strict=True), r.pressure, strict=True))
        for r in (recording, noisy_recording)
    ]
    both = sorted(set(keys[0]) & set(keys[1]))
    strong = [k for k in both if keys[0][k] > 0.2 * noisy.patch.peak]
    error = np.array([keys[1][k] - keys[0][k] for k in strong])
    sigma = 0.01 * noisy.patch.peak
    assert error.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * len(error)))
    assert abs(error.mean()) < 4 * sigma / np.sqrt(len(error))
    assert noisy_recording.pressure.min() > 0.05 * noisy.patch.peak


@pytest.mark.deep
def test_an_effect_that_is_off_leaves_the_rest_bit_for_bit(sphere, few):
    short = sphere.with_(exploration=few.exploration)
    recording = ms.simulate(short, seed=1)
    assert few.with_(effects=()).effects == ()
    quiet = ms.simulate(few.with_(effects=(), readout=sphere.readout), seed=1)
    assert quiet.readings.equals(recording.readings)
    louder = short.with_(effects=(GaussianNoise(sigma_relative=1e-3),))
    assert ms.simulate(louder, seed=1).contacts.equals(recording.contacts)


@pytest.mark.deep
def test_streaming_to_files_gives_the_same_recording(few, tmp_path):
    seen, recording = [], ms.simulate(few, seed=1)
    streamed = ms.simulate(
        few, seed=1, out=tmp_path / "r", progress=lambda *state: seen.append(state)
    )
    assert streamed.contacts.equals(recording.contacts)
    assert streamed.readings.equals(recording.readings)
    assert streamed.motion.num_rows == recording.motion.num_rows
    assert seen[-1][1] == seen[-1][2]
    assert streamed.metadata["steps_per_second"] > 0


def test_the_belief_holds_no_taxel_pose(noisy):
    belief = noisy.belief()
    assert belief.noise_sigma == pytest.approx(0.01 * noisy.patch.peak)
    assert belief.threshold == pytest.approx(0.05 * noisy.patch.peak)
    held = [v for v in vars(belief).values() if isinstance(v, np.ndarray)]
    assert all(v.ndim == 1 for v in held)
    assert not any(isinstance(v, ms.Skin) for v in vars(belief).values())


def test_an_arm_that_cannot_reach_says_so(sphere):
    far = sphere.with_(indenter=ms.Indenter.sphere(0.01, (3.0, 0.0, 0.7)))
    words = r"out of the arm's reach.* \(3.0, 0.0, 0.7\) m.*indenter.position_m"
    with pytest.raises(ReachError, match=words):
        ms.simulate(far)


def test_a_step_that_would_diverge_is_refused_with_one_that_works(sphere):
    stiff = sphere.with_(material=ms.Material(young=1e9), law=ms.Law(shape="identity", gain=5000.0))
    with pytest.raises(SimulationError, match=r"too long to be stable, .* set loop\.dt_ms = 0\.0"):
        ms.simulate(stiff)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"mount": np.eye(3)}, r"T_tip_body, got \(3, 3\)"),
        ({"arm": None}, "must be an Arm, not None"),
        ({"effects": ("gaussian_noise",)}, "got 'gaussian_noise'"),
        ({"effects": GaussianNoise()}, r"must be an Iterable, got .*; give a list"),
        ({"candidates": (3,)}, "scene.candidates must contain Effect objects, got 3"),
    ],
)
def test_a_scene_of_what_is_no_part_of_one_is_refused(sphere, changes, what):
    with pytest.raises(ConfigError, match=what):
        sphere.with_(**changes)


def test_a_path_that_is_none_or_of_other_steps_is_refused(sphere):
    scene = sphere.with_(loop=replace(sphere.loop, mode="quasi_static"))
    plan = ms.explore(scene.body, scene.skin, dt=2e-3)
    with pytest.raises(ConfigError, match=r"path must be a Path"):
        ms.simulate(scene, path=plan)
    with pytest.raises(ConfigError, match="another step than the loop, got 2 ms, limit: 1 ms"):
        ms.simulate(scene, path=plan.path)


def test_a_skin_off_the_body_is_refused(sphere):
    far = sphere.skin.moved(transform(np.eye(3), [0.0, 0.0, -0.05]))
    with pytest.raises(SkinError, match=r"got 49\.1 mm at the nearest taxel"):
        ms.simulate(sphere.with_(skin=far))


def test_a_seed_is_a_whole_number_also_where_nothing_is_random(sphere):
    assert not sphere.effects
    for run in (ms.simulate, lambda scene, seed: ms.press(scene, scene.skin.positions, seed=seed)):
        for seed in (1.5, -1):
            with pytest.raises(ConfigError, match=r"seed .* got"):
                run(sphere, seed=seed)
