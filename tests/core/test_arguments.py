"""Wrong arguments of the public functions: one line with the value, the limit and the remedy."""

from pathlib import Path

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import arguments
from meshskin.core.errors import MeshskinError


@pytest.fixture(scope="module")
def scene():
    return ms.Scene.load("sphere")


BODIES = {
    "two semi-axes": (lambda: ms.Body.ellipsoid((0.1, 0.1)), r"must be 3 numbers, got \(0.1, 0.1"),
    "one semi-axis": (lambda: ms.Body.ellipsoid(0.1), "must be 3 numbers, got 0.1"),
    "a word": (lambda: ms.Body.ellipsoid("abc"), "must be numbers, got 'abc'"),
    "radius in words": (lambda: ms.Body.sphere("0.1"), "must be a finite number, got '0.1'"),
    "radius None": (lambda: ms.Body.sphere(None), "must be a finite number, got None"),
    "no faces": (lambda: ms.Body.sphere(0.1, faces=0), "faces .*got 0, limit: at least 1"),
    "countless faces": (lambda: ms.Body.sphere(0.1, faces=10**9), "limit: at most 5e.06"),
    "half a face": (lambda: ms.Body.torus(0.1, 0.03, faces=1.5), "an integer, got 1.5"),
    "a slender capsule": (
        lambda: ms.Body.capsule(1e-6, 1.0),
        "lengths .*got radius : length of 1e.06",
    ),
    "a torus of nan": (lambda: ms.Body.torus(np.nan, 0.1), "finite number, got nan"),
}


@pytest.mark.parametrize(("call", "message"), BODIES.values(), ids=BODIES)
def test_wrong_bodies(call, message):
    with pytest.raises(MeshskinError, match=message):
        call()


NAMES = {
    "simulate": lambda name: ms.simulate(name),
    "cost": lambda name: ms.cost(name),
    "budget": lambda name: ms.budget(name),
    "tune": lambda name: ms.tune(name),
    "adapt": lambda name: ms.adapt(name, 1e-4),
    "press": lambda name: ms.press(name, [[0.0, 0.0, 0.1]]),
}


@pytest.mark.parametrize("call", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("name", ["sphere", Path("sphere")])
def test_a_name_in_place_of_a_scene(call, name):
    with pytest.raises(MeshskinError, match=r"must be a Scene, got .*Scene.load\('sphere'\)"):
        call(name)


CALLS = {
    "a name for a body": (lambda s: ms.explore("a.stl", s.skin), r"Body.load\('a.stl'\)"),
    "a scene for a body": (lambda s: ms.explore(s, s.skin), "must be a Body, got <Scene"),
    "skin of a name": (lambda s: ms.Skin.cover("sphere", 5e-3), "must be a Body, got 'sphere'"),
    "region of a number": (lambda s: ms.Skin.cover(s.body, 5e-3, region=3), "region .*got 3"),
    "half a taxel": (lambda s: ms.Skin.cover(s.body, count=2.5), "an integer, got 2.5"),
    "one pose": (lambda s: ms.Skin(np.eye(4), np.array([1])), r"limit: \(n, 4, 4\)"),
    "points of two": (lambda s: s.body.closest([1.0, 2.0]), r"got shape \(2,\), limit: \(n, 3\)"),
    "points of words": (lambda s: s.body.closest("abc"), "must be numbers, got 'abc'"),
    "a scene of names": (lambda s: ms.Scene(body="sphere", skin=s.skin), "body of a scene must"),
    "an arm of a name": (lambda s: s.with_(arm="puma"), "must be an Arm, got 'puma'"),
    "a negative payload": (lambda s: s.with_(payload=-1), "payload .*got -1 kg, limit: at least 0"),
    "a budget of nothing": (
        lambda s: s.with_(budget=0.0),
        "must be positive, got 0 mm",
    ),
    "a mount of nothing": (lambda s: s.with_(mount=np.full((4, 4), np.nan)), "mount must .*finite"),
    "effects of a number": (lambda s: s.with_(effects=3), "scene.effects .*got 3"),
    "a part that is none": (lambda s: s.with_(nam="x"), "unknown field 'nam'.*did you mean name"),
    "a field that is none": (lambda s: s.belief(noise=3), "'noise' .*did you mean noise_sigma"),
    "unknowns in a word": (lambda s: s.belief(unknown="gain"), r"write unknown=\(\"gain\",\)"),
    "a belief of a name": (lambda s: s.belief(body="x"), "body of a belief must be a Body"),
    "a contact of a name": (lambda s: s.belief(contact="herz"), "did you mean hertz"),
    "a payload beyond floats": (lambda s: s.with_(payload=10**400), "a finite number, got 1000"),
    "a complex payload": (lambda s: s.with_(payload=np.complex64(1)), "must be a finite number"),
    "onto within nan": (lambda s: s.skin.onto(s.body, np.nan), "within must be a finite number"),
    "a skin of nothing": (
        lambda s: s.with_(skin=ms.Skin(np.empty((0, 4, 4)), np.empty(0, dtype=int))),
        "number of a scene's taxels .*got 0, limit: at least 1",
    ),
    "faces by halves": (lambda s: s.body.closest(np.ones((2, 3)), 0.5), "must be integers"),
    "too many faces": (
        lambda s: s.body.closest(np.ones((2, 3)), [0, 1, 2]),
        r"one for each point, got shape \(3,\) of int64, limit: \(2,\)",
    ),
    "a ray without a direction": (
        lambda s: s.body.project(np.ones((2, 3)), [[0.0, 0.0, 1.0]]),
        "got 2 origins, 1 directions",
    ),
    "no slide": (lambda s: ms.tune(s, distance=0), "distance .*got 0 m, limit: above 0 m"),
    "no world": (lambda s: ms.tune(s, over=()), r"got \(\), limit: one Scenario or more"),
    "a world of a word": (lambda s: ms.tune(s, over="soft"), "got 'soft', limit: one Scenario"),
    "a place of two": (lambda s: ms.tune(s, place=(1, 2)), r"place must be 3 numbers"),
    "bounds of one": (lambda s: ms.tune(s, bounds={"gamma": 3}), "bounds of gamma must be 2 num"),
    "a gain of a name": (lambda s: ms.tune(s, bounds={"gama": (1, 2)}), "did you mean gamma"),
    "a force of a word": (lambda s: ms.explore(s.body, s.skin, force="a"), "force .*got 'a'"),
    "a budget in words": (lambda s: ms.budget(s, "a"), "error budget must be a Real, got 'a'"),
    "a recording of a name": (
        lambda s: ms.calibrate("rec", s.belief()),
        r"Recording.load\('rec'\)",
    ),
    "finer than nothing": (lambda s: ms.cost(s, finer=0), "finer .*got 0, limit: at least 1"),
    "a target of nothing": (lambda s: ms.cost(s, targets=[0]), "target .*got 0 mm, limit: above 0"),
    "targets of a number": (lambda s: ms.cost(s, targets=3), "targets.*got 3"),
    "a press of two": (lambda s: ms.press(s, [[0.0, 0.1]]), r"got shape \(1, 2\)"),
    "a press of a word": (lambda s: ms.press(s, [[0, 0, 0.1]], force="a"), "numbers, got 'a'"),
    "a study of a number": (lambda s: ms.Study("n", base=3).cases(), "base .*Scene, got 3"),
    "a grid of a number": (lambda s: ms.Study("n", base=s, grid=3).cases(), "grid .*got 3"),
    "a study for ever": (lambda s: ms.Study("n", time_limit="a"), "time_limit .*got 'a'"),
    "a scene of a scene": (lambda s: ms.Scene.load(s), "loaded by its name .*got <Scene"),
    "skins of names": (lambda s: ms.compare("a.csv", s.skin), r"Skin.load\('a.csv'\)"),
}


@pytest.mark.parametrize(("call", "message"), CALLS.values(), ids=CALLS)
def test_wrong_calls(scene, call, message):
    with pytest.raises(MeshskinError, match=message) as caught:
        call(scene)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_one_scenario_may_be_given_without_a_list(scene):
    from meshskin.tuning.scenarios import Scenario
    from meshskin.tuning.tune import check_scenarios

    assert check_scenarios(Scenario(1.2)) == (Scenario(1.2),)


def test_remedies_name_contact_models_that_a_scene_takes(scene):
    wide = scene.with_(law=ms.Law(force_reference=60.0))
    with pytest.raises(MeshskinError, match="too wide") as caught:
        ms.simulate(wide)
    assert 'contact.solve(model="field") holds for a single contact' in str(caught.value)


def test_messages_are_one_line_without_control_characters():
    error = MeshskinError("a bad row", value="1\x00\n2\t\x1b[31m", remedy="write it\nanew")
    assert str(error) == "a bad row, got 1? 2 ?[31m; write it anew"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ms.read_log(None), "a log must be a path, got None"),
        (lambda: ms.LogMap.load(None), "a map file must be a path, got None"),
        (lambda: ms.lint(3), "a skin file must be a path, got 3"),
        (lambda: ms.Arm.from_urdf(None), "the arm must be a path, got None"),
        (lambda: ms.PoseGraph.load(3), "a pose graph must be a path, got 3"),
        (lambda: ms.Study.load(None), "a study file must be a path, got None"),
        (lambda: ms.Robot.from_urdf(None), "the URDF of a robot must be a path, got None"),
        (lambda: ms.layout(np.eye(4), spacing=5), r"got 5 m, limit: at most 0.1 m; give it in met"),
    ],
)
def test_paths_that_are_none_and_millimetres(call, words):
    with pytest.raises(MeshskinError, match=words):
        call()


def test_long_values_are_cut_between_words():
    names = ", ".join(f"column{k}" for k in range(20))
    cut = arguments.repr_short([names])
    assert cut.endswith("column4, ...") or cut.endswith("column5, ...")
    assert len(cut) <= arguments.REPR_LENGTH + 1
    assert arguments.repr_short("x" * 100) == f"'{'x' * 56}..."
