"""The parts of an error budget, each against what is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin import effects
from meshskin.effects.body_pose import BodyPose
from meshskin.effects.gain_offset import GainOffset
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.effects.mesh_facets import facets
from meshskin.effects.quantisation import Quantisation
from meshskin.effects.relaxation import Relaxation
from meshskin.geometry.region import Cap
from meshskin.study.sensitivity.budget import BudgetTrial
from meshskin.study.sensitivity.budget_report import BudgetReport, Check, Entry
from meshskin.study.sensitivity.knobs import contact_models, mesh_bodies, scene_knobs
from meshskin.study.sensitivity.replay import Holdout, Replay
from meshskin.study.sensitivity.selection import (
    NEGLIGIBLE,
    Item,
    candidates,
    choose,
    left_out,
    mean_length,
    screened,
    with_required,
)
from meshskin.study.sensitivity.setting import with_changes
from meshskin.study.sensitivity.shifts import Solution, determined_taxels


@pytest.fixture(scope="module")
def small():
    """A sphere of 12 taxels that moves without an arm, read at 50 Hz."""
    scene = ms.Scene.load("sphere")
    skin = ms.Skin.cover(scene.body, spacing=5e-3, count=12, region=Cap((0.0, 0.0, -1.0)))
    return scene.with_(
        skin=skin,
        loop=replace(scene.loop, mode="quasi_static"),
        readout=replace(scene.readout, rate=50.0),
    )


@pytest.fixture(scope="module")
def replay(small):
    return Replay.of(small)


@pytest.fixture(scope="module")
def solved(small, replay):
    """Belief, recording without effects, and the solution there."""
    belief = small.with_(effects=(GaussianNoise(),)).belief()
    recording = replay.recording((), 0)
    found = ms.calibrate(recording, belief)
    shared = np.array([value for value, _ in found.unknowns.values()])
    return belief, recording, Solution(found.positions, shared)


def moved(solved, recording):
    belief, plain, solution = solved
    return solution.step(recording, belief)[0] - solution.step(plain, belief)[0]


def test_a_displaced_body_moves_the_taxels_as_its_feet_move(small, replay, solved):
    """The foot of a centre that moves along the sphere moves by R / (R + r) of it, r being the
    indenter's radius less the depth."""
    offset = 5e-5
    recording = replay.recording((BodyPose(translation=(offset, 0.0, 0.0)),), 0)
    shift = moved(solved, recording)
    normals = small.skin.normals
    height = small.indenter.radius - small.patch.depth
    along = offset * (np.array([1.0, 0.0, 0.0]) - normals[:, :1] * normals)
    np.testing.assert_allclose(shift, along * 0.1 / (0.1 + height), atol=0.03 * offset)


@pytest.mark.deep
@pytest.mark.parametrize(
    "effect",
    [IndenterOffset((5e-5, 3e-5, 0.0)), GainOffset(0.005, 0.0), Relaxation(0.99)],
    ids=lambda effect: effect.name,
)
def test_one_step_predicts_the_full_calibration(effect, replay, solved):
    belief, _, solution = solved
    recording = replay.recording((effect,), 3)
    full = ms.calibrate(recording, belief).positions - solution.points
    step = moved(solved, recording)
    assert mean_length(step - full) < 0.1 * mean_length(full)


def test_one_step_predicts_the_calibration_on_a_coarser_mesh(small, replay):
    """The coarser surface lies beside the fine one: taxels move onto it, along the normals, too."""
    belief = replace(small.belief(), body=small.body.remeshed(320))
    recording = replay.recording((), 0)
    found = ms.calibrate(recording, belief).positions - small.skin.positions
    move, _ = Solution.true(small).step(recording, belief)
    np.testing.assert_allclose(move, found, atol=0.1 * mean_length(found))


def test_a_replay_records_the_same_as_a_simulation(small, replay):
    chosen = (GaussianNoise(), BodyPose(), effects.find("friction")(), effects.find("scan_order")())
    simulated = ms.simulate(small.with_(effects=effects.ordered(chosen)), seed=5)
    replayed = replay.recording(chosen, 5)
    for name in ("time", "points", "normals", "force", "reading_taxel", "pressure"):
        np.testing.assert_allclose(getattr(replayed, name), getattr(simulated, name), rtol=1e-9)


def test_halves_hold_every_contact_of_their_taxels(small):
    skin = ms.Skin.cover(small.body, spacing=5e-3, count=60, region=Cap((0.0, 0.0, -1.0)))
    replay, noisy = Replay.of(small.with_(skin=skin)), (GaussianNoise(), Relaxation())
    whole, halves = replay.recording(noisy, 1), replay.halves()
    assert halves.cut
    assert not set(halves.taxels[0]) & set(halves.taxels[1])
    for half in (0, 1):
        part = replay.recording(noisy, 1, halves, half)
        for taxel in halves.taxels[half]:
            mine, there = (
                np.sort(r.pressure[(r.reading_taxel == taxel) & (r.pressure > 8e3)])
                for r in (whole, part)
            )
            assert len(mine)
            np.testing.assert_allclose(mine, there)


def test_a_small_skin_is_not_cut(replay):
    halves = replay.halves()
    assert not halves.cut
    assert len(halves.taxels[0]) == len(halves.taxels[1]) == 12
    assert halves.frames(replay.frames.points, 1).all()


def test_dead_taxels_are_not_determined(small, replay):
    belief = small.with_(effects=(GaussianNoise(),)).belief()
    broken = effects.find("broken_taxels")(dead=0.2, stuck=0.0)
    lost = ~determined_taxels(replay.recording((GaussianNoise(), broken), 2), belief)
    assert set(np.flatnonzero(lost)) == set(broken.chosen(small.context(2))[0])


class Stub(effects.BaseEffect):
    """An effect that is only a bound."""

    stage, cost = "transducer", 1e-9

    def __init__(self, name, bound, requires=()):
        self.name, self.largest, self.requires = name, bound, requires

    def bound(self, context):
        return self.largest

    def build(self, context):
        return lambda pressures, frames: pressures


def test_screening_never_drops_an_effect_above_its_bound(small):
    rng = np.random.default_rng(1)
    for _ in range(50):
        budget = 10 ** rng.uniform(-5, -3)
        stubs = [Stub(f"e{k}", 10 ** rng.uniform(-8, -3)) for k in range(10)]
        out = screened(stubs, small.context(0), budget)
        assert sum(out.values()) <= NEGLIGIBLE * budget
        assert all(out[s.name] == s.largest for s in stubs if s.name in out)
        kept = [s.largest for s in stubs if s.name not in out]
        assert not out or not kept or max(out.values()) <= min(kept)
    needed = Stub("needed", 1e-9)
    assert not screened([needed, Stub("large", 1.0, ("needed",))], small.context(0), 1e-3)
    assert set(screened([Quantisation(bits=16), BodyPose()], small.context(0), 2e-4)) == {
        "quantisation"
    }


def item(name, x, y, seconds, requires=()):
    return Item(name, np.array([[[x, y, 0.0]]]), seconds, requires)


def test_items_are_chosen_by_shift_per_second():
    items = [item("cheap", 3.0, 0.0, 1.0), item("dear", 0.0, 4.0, 100.0), item("small", 0.1, 0, 1)]

    def joint(on):
        return left_out(on, items)

    assert choose(items, 6.0, (), joint)[0] == set()
    assert choose(items, 4.05, (), joint)[0] == {"cheap"}
    assert choose(items, 3.2, (), joint)[0] == {"dear"}
    assert choose(items, 1e-9, (), joint)[0] == {"cheap", "dear", "small"}
    assert choose(items, 6.0, ("small",), joint)[0] == {"small"}
    assert mean_length(choose(items, 3.2, (), joint)[1]) == pytest.approx(3.1)


def test_parts_that_cancel_or_require_each_other():
    items = [item("up", 5.0, 0.0, 1.0), item("down", -5.0, 0.1, 1.0)]
    assert choose(items, 0.2, (), lambda on: left_out(on, items))[0] == set()
    ladder = [item("k:0", 1.0, 0.0, 1.0), item("k:1", 2.0, 0.0, 1.0, ("k:0",))]
    assert choose(ladder, 1.5, (), lambda on: left_out(on, ladder))[0] == {"k:0", "k:1"}


def test_shifts_that_do_not_add_up_are_measured_together():
    """Two effects that together do three times the sum of what they do alone."""
    items = [item("a", 1.0, 0.0, 1.0), item("b", 1.0, 0.0, 2.0)]

    def joint(on):
        rest = left_out(on, items)
        return rest if on else 3.0 * rest

    on, rest = choose(items, 2.5, (), joint)
    assert len(on) == 1
    assert mean_length(rest) == pytest.approx(1.0)


def test_candidates_are_the_effects_that_can_be_built(small):
    found, refused = candidates(small)
    names = {e.name for e in found}
    assert "encoder" not in names
    assert "joints" in refused["encoder"]
    assert names | set(refused) == {e.name for e in effects.registered()}
    own = BodyPose(translation=(0.0, 1e-3, 0.0))
    scene = small.with_(effects=(own,), candidates=(BodyPose(), GainOffset()))
    assert candidates(scene)[0] == (GainOffset(), own)
    rival = Stub("rival", 1.0)
    rival.excludes = ("body_pose",)
    lone = Stub("lone", 1.0, ("nobody",))
    found, refused = candidates(scene.with_(candidates=(rival, lone)))
    assert found == (own,)
    assert refused == {"rival": "excluded by body_pose", "lone": "requires nobody"}


def knobs(scene):
    """The knobs of a scene, by name."""
    return {k.name: k for k in scene_knobs(scene, mesh_bodies(scene), 10_000, 1_000.0)}


@pytest.mark.deep
def test_levels_of_knobs_are_ordered_from_cheap_to_fine(small):
    found = knobs(small)
    assert set(found) == {"contact model", "mesh", "time step"}
    for knob in found.values():
        seconds = [level.seconds for level in knob.levels]
        assert seconds == sorted(seconds)
    mesh, step = found["mesh"], found["time step"]
    bodies = mesh_bodies(small)
    assert bodies[mesh.levels[mesh.declared].changes["faces"]] is small.body
    assert [r.changes["faces"] for r in mesh.levels] == [320, 1280, 5120, 20480]
    for level in step.levels:
        fine = with_changes(small, level.changes)
        assert fine.frame_steps * fine.loop.dt == pytest.approx(0.02)
    assert [r.label for r in found["contact model"].levels] == ["hertz", "elliptic"]
    capsule = ms.Scene.load("capsule")  # a circle does not hold on its cylinder
    assert "contact model" not in knobs(capsule)
    for body in bodies.values():
        assert body.facets is small.body.mesh, "the mesh in the robot's software is not changed"
    sharp = small.with_(body=ms.Body.ellipsoid((0.09, 0.075, 0.06)))  # 320 faces: flat at its ends
    mesh = knobs(sharp)["mesh"]
    assert [r.changes["faces"] for r in mesh.levels] == [1280, 5120, 20480]
    loaded = replace(small.body, exact=None)
    assert set(knobs(small.with_(body=loaded))) == {"contact model", "time step"}
    for thickness, names in ((8e-3, []), (60e-3, ["hertz", "elliptic", "layered"])):
        material = replace(small.material, thickness=thickness)
        models = contact_models(small.with_(material=material, contact="layered"))
        assert models == (names or ["layered"])


@pytest.fixture(scope="module")
def trial(small):
    """Noise, a threshold above it, and facets, on trial."""
    names = ("gaussian_noise", "sensing_range", "mesh_facets")
    return BudgetTrial(small, effects.ordered([effects.find(n)() for n in names]), 0.2e-3, (0,))


@pytest.mark.slow
def test_an_effect_that_removes_readings_has_negative_seconds(trial):
    """Noise makes every taxel answer in every contact; a threshold takes most of that away."""
    assert trial.seconds["sensing_range"] < 0 < trial.seconds["gaussian_noise"]
    assert "saves more readings" in trial.forced(1.0)["sensing_range"]
    assert "gaussian_noise" not in trial.forced(1.0)


@pytest.mark.deep
def test_facets_are_those_of_the_declared_mesh(trial):
    """However coarse or fine the mesh that the smooth surface is fitted to."""
    with_them = trial.scene_with(with_required(["mesh_facets"], trial.items))
    assert len(with_them.body.mesh.faces) == 320
    assert len(trial.everything.body.mesh.faces) == 20_480
    centres = 0.105 * with_them.skin.normals
    feet = [facets(scene.context(0))(centres) for scene in (trial.scene, with_them)]
    np.testing.assert_array_equal(feet[0], feet[1])
    coarse = with_them.with_(body=replace(with_them.body, robot_mesh=None))
    assert np.linalg.norm(facets(coarse.context(0))(centres)[0] - feet[0][0], axis=1).max() > 1e-4


@pytest.mark.deep
def test_the_tolerance_is_measured(trial, small):
    knob = trial.tolerance
    moves = [level.shift for level in knob.levels]
    assert [level.label for level in knob.levels] == ["1", "0.01", "1e-08"]
    assert all(level.seconds > 0 for level in knob.levels)
    assert mean_length(moves[-1]) == 0.0 < mean_length(moves[0])
    recording, belief = trial.shifts.recordings[0], trial.belief
    loose, tight = (ms.calibrate(recording, belief, tolerance=t).positions for t in (1.0, 1e-8))
    np.testing.assert_allclose(moves[0], (loose - tight)[trial.halves.taxels[0]])
    assert trial.tolerance_with(()) == 1.0
    assert trial.tolerance_with({"solver tolerance:0", "solver tolerance:1"}) == 1e-8


@pytest.mark.slow
def test_everything_on_is_calibrated_once(trial, monkeypatch):
    aside = Holdout(trial.everything, trial.belief, trial.path, trial.halves, (2,))
    ran = []
    plain = aside._calibrated
    monkeypatch.setattr(aside, "_calibrated", lambda *args: ran.append(args) or plain(*args))
    first, second = (aside.check(trial.scene_with(()), 1.0) for _ in range(2))
    assert (first.shift, first.seconds[0]) == (second.shift, second.seconds[0])
    assert len(ran) == 3


def test_a_budget_that_is_exceeded_says_why():
    entries = [
        Entry("hysteresis", "on", True, 0.6e-3, 0.1, ""),
        Entry("crosstalk", "off", False, 0.15e-3, 0.1, ""),
        Entry("layer", "off", False, 0.0, 0.1, ""),
        Entry("dt", "1 ms", True, 0.9e-3, 0.1, ""),
    ]
    check = Check(shift=0.3e-3, taxels=80, lost=2, seconds=(2.0, 1.0))
    report = BudgetReport(0.2e-3, tuple(entries), 0.15e-3, check, None, None, None, 1e-8)
    first = report.summary()[0]
    assert "The budget of 0.2 mm is exceeded" in first
    assert "0.3 mm together, estimated 0.15 mm; 2 taxels are lost" in first
    assert "largest alone: crosstalk 0.15 mm;" in first
    within = replace(report, check=Check(0.19e-3, 80, 0, (2.0, 1.0)))
    *rows, total = [row[3] for row in within.table()[1]]
    assert total == "1.000"
    summed = sum(float(seconds) for seconds in rows if not seconds.startswith("("))
    assert summed == pytest.approx(1.0), "of what is on and of the rest"
    assert sum(seconds.startswith("(") for seconds in rows) == sum(not e.on for e in entries)
    assert within.exceeded == ""
    assert within.summary()[0].startswith("Budget 0.2 mm")
    assert report.explain(0.19e-3) == ""
    words = report.explain(0.545e-3)
    assert "mean error of 0.545 mm is above the budget of 0.2 mm" in words
    assert "move the taxels, too: hysteresis 0.6 mm;" in words
