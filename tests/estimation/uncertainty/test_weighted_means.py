"""Positions against weighted means of contact points, where the contacts are few and in lanes."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.chart import frames
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.departures import MIN_SCORE
from meshskin.estimation.result import OTHER_RESPONSE
from meshskin.estimation.uncertainty import weighted_means

PITCH = 2.5e-3
"""Distance of the lanes, m: 1.3 times the reach of a contact."""


@pytest.fixture(scope="module")
def lanes():
    """A small sphere pressed in lanes, between which its taxels lie off the middle."""
    body = ms.Body.sphere(0.03)
    y, x = np.meshgrid(np.arange(-4, 5) * PITCH, np.arange(-8e-3, 8e-3, 0.4e-3), indexing="ij")
    points = body.closest(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.03)])).point
    sites = body.closest(
        [[1.7e-3 * k, PITCH * (j + 0.42), 0.03] for k in range(-2, 3) for j in range(-2, 2)]
    )
    poses = np.tile(np.eye(4), (len(sites.point), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frames(sites.normal), sites.point
    scene = ms.Scene(
        body=body,
        skin=ms.Skin(poses, np.arange(len(poses)), disc_radius=1e-3),
        indenter=ms.Indenter.sphere(2e-3),
        material=ms.Material(young=1.2e6),
        law=ms.Law(force_reference=1.0),
        effects=[ms.effects.find("gaussian_noise")(sigma_relative=0.01)],
    )
    return scene, ms.press(scene, points, seed=1)


def test_means_over_few_lanes_are_no_doubt(lanes):
    scene, recording = lanes
    found = ms.calibrate(recording, scene.belief())
    off = np.linalg.norm(found.contact_centroids - scene.skin.positions, axis=1)
    assert np.median(off) > 0.5e-3
    assert np.nanmax(np.linalg.norm(found.positions - scene.skin.positions, axis=1)) < 0.2e-3
    assert found.verdict.level == "PASS"
    wrong = found.poses.copy()
    wrong[:, :3, 3] += [0.0, 1.5e-3, 0.0]
    data = gather(recording, scene.belief())
    assert list(weighted_means.findings(data, found)) == []
    ((level, words),) = weighted_means.findings(data, replace(found, poses=wrong))
    assert level == "FAIL"
    assert "from the pressure-weighted means" in words


def test_groups_that_respond_otherwise_widen_by_the_distance_from_the_means(lanes):
    scene, recording = lanes
    belief = scene.belief(contact="learned")
    found = ms.calibrate(recording, belief)
    poses = found.poses.copy()
    poses[:, 0, 3] += 0.3e-3  # along the lanes: across them the mean is that of the nearest one
    moved, data = replace(found, poses=poses), gather(recording, belief)
    shown = {OTHER_RESPONSE.format("modules"): 2 * MIN_SCORE}
    assert weighted_means.widened(data, moved, {"drag": 2 * MIN_SCORE}) is moved
    wide = weighted_means.widened(data, moved, shown)
    seen = np.isfinite(found.positions[:, 0])
    turned = found.poses[seen, :3, :3]
    added = (wide.covariances[seen] - moved.covariances[seen])[:, :3, :3]
    along = np.einsum("ni,nij,nj->n", turned[:, 0], added, turned[:, 0])
    assert np.median(np.sqrt(along[along > 0])) == pytest.approx(0.3e-3, rel=0.3)
