"""What is printed of the objects that hold arrays: one line each."""

import numpy as np

import meshskin as ms
from meshskin.estimation.adaptive import Adaptive
from meshskin.exploration.path import Path, Plan
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording


def test_scenes_and_their_parts_print_one_line(sphere):
    for thing in (sphere, sphere.body, sphere.skin, sphere.arm):
        text = repr(thing)
        assert "array" not in text
        assert "\n" not in text
        assert len(text) < 300
    assert f"{len(sphere.skin)} taxels" in repr(sphere.skin)
    assert repr(sphere.skin) in repr(sphere)
    assert sphere.arm.name in repr(sphere.arm)


def test_calibrations_print_what_was_found(sphere):
    recording = ms.press(sphere, sphere.skin.positions)
    text = repr(ms.calibrate(recording, sphere.belief()))
    assert "array" not in text
    assert f"of {len(sphere.skin)} taxels, " in text
    assert f"{len(recording.pressure)} readings" in text


def test_recordings_print_their_size():
    empty = Recording(
        CONTACT_SCHEMA.empty_table(), READING_SCHEMA.empty_table(), {"taxel_ids": np.arange(3)}
    )
    assert "0 contacts" in repr(empty)
    assert "of 3 taxels, without" in repr(empty)


def test_plans_print_how_long_they_are():
    points = np.zeros((5, 3))
    path = Path(
        0.5,
        points,
        points,
        np.tile(np.eye(4), (5, 1, 1)),
        np.zeros((5, 6)),
        np.zeros(5, int),
        unreachable={7: "joint limit"},
    )
    text = repr(Plan(path, 2e-3))
    assert "1 segment, 2.5 s" in text
    assert "1 taxel left out" in text
    assert "array" not in text


def test_estimates_print_what_came_of_them(sphere):
    found = ms.calibrate(ms.press(sphere, sphere.skin.positions), sphere.belief())
    recording = ms.press(sphere, sphere.skin.positions[:2])
    adaptive = repr(Adaptive(recording, found, (), {3: "never read"}))
    assert adaptive == "<Adaptive: 0 rounds, 2 contacts, 1 of 80 taxels above the target>"
    eyes = np.tile(np.eye(4), (3, 1, 1))
    graph = ms.PoseGraph(eyes, np.array([[0, 1], [1, 2]]), eyes[:2], np.tile(np.eye(6), (2, 1, 1)))
    assert repr(graph) == "<PoseGraph: 3 poses, 2 displacements>"
    assert repr(graph.solve()).startswith(
        f"<PoseGraphSolution of {graph!r}: optimal, geodesic cost"
    )


def test_modules_print_their_number():
    body = ms.Body.capsule(radius=0.04, length=0.15)
    made = ms.Skin.modules(body, region=ms.Disc(point=(0.04, 0, 0), radius=0.04))
    assert repr(made) == f"<Modules: {len(made)}, 10 taxels each>"
