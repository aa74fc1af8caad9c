"""Distances below a limit, by bounds and by the distances themselves."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.geometry.surface.distance_grid import DistanceGrid


@pytest.mark.parametrize("open_", [False, True])
def test_bounds_decide_as_the_distances_do(open_, monkeypatch, tmp_path):
    import trimesh

    mesh = trimesh.creation.box((0.1, 0.06, 0.03))
    mesh = mesh.subdivide().subdivide()
    if open_:
        mesh = mesh.submesh([np.flatnonzero(mesh.triangles_center[:, 0] < 0.049)])[0]
    mesh.export(tmp_path / "box.stl")
    body = ms.Body.load(tmp_path / "box.stl", units="m", open=open_)
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.09, 0.09, (4000, 3))
    limits = rng.choice([-0.005, 0.0, 0.02, 0.04], 4000)
    grid = DistanceGrid(body.surface, 0.05)
    wanted = body.closest(points).distance < limits
    assert 400 < wanted.sum() < 3600
    asked = []
    closest = body.surface.closest
    monkeypatch.setattr(body.surface, "closest", lambda p: asked.append(len(p)) or closest(p))
    np.testing.assert_array_equal(grid.within(points, limits), wanted)
    assert sum(asked) == 4000 if open_ else sum(asked) < 1500
