"""Objects that a user holds: copies, pickles, cloudpickle, equality."""

import copy
import pickle
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.value import Value, same_content
from meshskin.estimation.recalibrate.skin_map import skin_map
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.scene import shipped_scenes


@pytest.fixture(scope="module")
def objects(sphere, recording):
    """One object of every public class that is data, used before, so that its caches are filled."""
    belief = sphere.belief()
    calibration = ms.calibrate(recording, belief, "centroid")
    _ = sphere.arm.newton, sphere.arm.holds_any_pose
    plan = ms.explore(sphere.body, sphere.skin, mode="quasi_static")
    sphere.body.project([[0, 0, 1.0]], [[0, 0, -1.0]])
    identity = np.eye(6)[None]
    graph = ms.PoseGraph(np.stack([np.eye(4)] * 2), [[0, 1]], np.eye(4)[None], identity)
    graph.solve()
    few = sphere.with_(skin=ms.Skin(sphere.skin.poses[:12], sphere.skin.ids[:12]))
    recalibration = ms.recalibrate(few.skin, ms.press(few, few.skin.positions), few.belief())
    still = {"chain": None, "angles": np.zeros((1, 0)), "positions": np.zeros((1, 3))}
    return {
        "Arm": sphere.arm,
        "Belief": belief,
        "Body": sphere.body,
        "Calibration": calibration,
        "Cap": ms.Cap((0.0, 0.0, 1.0), 0.5),
        "Closest": sphere.body.closest(sphere.skin.positions),
        "Faces": ms.Faces(np.arange(3)),
        "LogMap": LogMap((StreamMap("/skin", "taxels"),)),
        "Modules": ms.Skin.modules(ms.Body.sphere(0.1, faces=1280), count=1),
        "NextContacts": calibration.next_contacts(2),
        "Patch": sphere.patch,
        "Robot": ms.Robot.from_urdf(shipped_scenes.folder() / "puma560.urdf"),
        "ContactFrames": ms.ContactFrames(np.ones((2, 3)), 3.0),
        "Exploration": sphere.exploration,
        "Indenter": sphere.indenter,
        "Law": sphere.law,
        "Material": sphere.material,
        "Plan": plan,
        "PoseGraph": graph,
        "Readout": sphere.readout,
        "Recalibration": recalibration,
        "Recording": recording,
        "Scene": sphere,
        "Skin": calibration.skin,
        "SkinMap": skin_map(sphere.skin, belief),
        "Study": ms.Study("noise", base="sphere", seeds=2),
        "TouchDesign": recalibration.next_contacts(2, few.belief()),
        "TouchSide": ms.TouchSide(readings=np.ones((1, 1)), **still),
    }


NAMES = (
    "Arm", "Belief", "Body", "Calibration", "Cap", "Closest", "ContactFrames", "Exploration",
    "Faces", "Indenter", "Law", "LogMap", "Material", "Modules", "NextContacts", "Patch", "Plan",
    "PoseGraph", "Readout", "Recalibration", "Recording", "Robot", "Scene", "Skin", "SkinMap",
    "Study", "TouchDesign", "TouchSide",
)  # fmt: skip


@pytest.mark.parametrize("way", ["copy", "pickle", "cloudpickle"])
@pytest.mark.parametrize("name", NAMES)
def test_an_object_comes_back_equal(objects, name, way):
    one = objects[name]
    if way == "copy":
        other = copy.deepcopy(one)
    else:
        package = pytest.importorskip(way)
        other = pickle.loads(package.dumps(one))
    assert other is not one
    assert type(other) is type(one)
    assert other == one
    assert one != 3
    if name != "Study":
        assert hash(other) == hash(one)


@pytest.mark.deep
def test_a_copy_works_as_the_original_does(objects, recording):
    scene = copy.deepcopy(objects["Scene"])
    found = ms.calibrate(recording, scene.belief(), "centroid")
    again = pickle.loads(pickle.dumps(found))
    assert again == found
    assert again.skin == found.skin


@pytest.mark.deep
def test_two_runs_of_one_scene_are_equal(objects, recording):
    """They differ in the times that they took alone."""
    again = replace(recording, metadata=recording.metadata | {"steps_per_second": 1.0})
    assert again == recording
    assert ms.calibrate(again, objects["Belief"], "centroid") == objects["Calibration"]
    assert replace(recording, metadata=recording.metadata | {"threshold_pa": 1.0}) != recording


def test_what_differs_is_unequal(objects, sphere):
    c = objects["Calibration"]
    moved = c.poses.copy()
    moved[0, 0, 3] += 1e-12
    assert replace(c, poses=moved) != c
    assert sphere.with_(payload=2.0) != sphere
    assert ms.Body.sphere(0.1) == ms.Body.sphere(0.1)
    assert ms.Body.sphere(0.1) != ms.Body.sphere(0.11)
    assert ms.Skin(np.eye(4)[None], np.array([1])) != ms.Skin(np.eye(4)[None], np.array([2]))
    assert sphere.body != sphere.skin


def test_content_is_compared_by_entries():
    assert same_content({"a": [1.0, np.nan]}, {"a": [1.0, float("nan")]})
    assert same_content(np.array([np.nan, 1]), np.array([np.nan, 1]))
    assert not same_content(np.array([1, 2]), np.array([1, 2, 3]))
    assert not same_content((1, 2), (1, 3))
    assert not same_content({"a": 1}, {"b": 1})
    assert not same_content(1, "1")


@pytest.mark.parametrize(
    ("one", "other"),
    [(1, 1.0), (1, np.int64(1)), (True, np.bool_(True)), (0.5, np.array(0.5)),
     ([1, 2], np.arange(1, 3)), (float("nan"), float("nan")), ({"a": 1}, {"a": 1.0})],
)  # fmt: skip
def test_equal_objects_have_equal_hashes(one, other):
    @dataclass(frozen=True, eq=False)
    class Held(Value):
        value: object
        aside: object = field(default=0, compare=False)

    assert Held(one) == Held(other, aside=1)
    assert hash(Held(one)) == hash(Held(other, aside=1))
    assert Held(one) in {Held(other)}


def test_no_dataclass_replaces_the_comparison_of_its_content():
    def below(kind):
        return {kind}.union(*map(below, kind.__subclasses__()))

    for name in ms.__all__:
        getattr(ms, name)
    kinds = below(Value) - {Value}
    assert len(kinds) > 10
    for kind in kinds:
        assert kind.__eq__ is Value.__eq__, f"{kind.__name__} must be declared with eq=False"
