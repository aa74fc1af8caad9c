"""Motions of all contact points along which the believed surface does not change are named."""

import re
from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty.unseen_motions import unseen_motions
from meshskin.geometry.region import Cap


def calibrated(body, direction, moved=0.0, count=20):
    """Taxels about a direction of a body, with contact points moved along z, m."""
    base = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(body, spacing=6e-3, count=count, region=Cap(direction=direction), seed=1)
    scene = base.with_(body=body, skin=skin, contact="elliptic")
    rng = np.random.default_rng(0)
    near = skin.positions[rng.integers(count, size=200)] + rng.uniform(-4e-3, 4e-3, (200, 3))
    log = ms.press(scene, body.closest(near).point)
    log = replace(log.with_columns(points=log.points + np.array([0.0, 0.0, moved])), metadata={})
    found = ms.calibrate(log, scene.belief())
    return found, found.positions - skin.positions


@pytest.mark.deep
@pytest.mark.parametrize("moved", [0.0, 1e-3])
def test_a_slide_along_a_cylinder_is_named(moved):
    """By 1 mm the whole map is displaced, and nothing in the log shows it."""
    found, error = calibrated(ms.Body.capsule(radius=0.04, length=0.15), (1.0, 0.0, 0.0), moved)
    assert np.median(error[:, 2]) == pytest.approx(moved, abs=0.05e-3)
    assert np.median(found.position_sigma) < 0.1e-3
    (words,) = [words for words in found.undetermined if "surface does not show" in words]
    assert "a displacement along (0, 0, 1), a turn about (0, 0, 1) through" in words


def test_a_ball_turns_about_its_middle(tmp_path):
    found, _ = calibrated(ms.Body.sphere(0.1), (0.0, 0.0, 1.0))
    (words,) = [words for words in found.undetermined if "surface does not show" in words]
    centre = re.search(r"show any turn about the point \((.*?)\) mm of all", words)
    assert np.abs(np.fromstring(centre[1], sep=",")).max() < 2.0  # mm, of a radius of 100 mm
    assert found.verdict.untested[0] == words
    assert f"  not tested: {words}\n" in str(found.verdict)
    found.save(tmp_path / "calibration")
    assert ms.Calibration.load(tmp_path / "calibration").verdict == found.verdict


def test_an_ellipsoid_shows_every_motion():
    """By contacts all around it."""
    scene = ms.Scene.load("ellipsoid")
    ways = np.random.default_rng(0).normal(size=(300, 3))
    points = scene.body.closest(0.2 * ways / np.linalg.norm(ways, axis=1)[:, None]).point
    log = ms.press(scene, points)
    (words,) = unseen_motions(gather(log, scene.belief()))
    assert "were computed on the believed surface" in words
    assert not unseen_motions(gather(log, scene.belief(surface_sigma=0.1e-3)))
    scatter = 5e-6 * np.random.default_rng(1).normal(size=log.points.shape)
    measured = log.with_columns(points=log.points + scatter)
    assert not unseen_motions(gather(measured, scene.belief()))
