"""Heights over bodies on which the contacts nearly fit in more than one place."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.kinematics.heights import Heights
from meshskin.robot.contact_kinematics import JointPath

RADIUS, DEPTH = 8e-3, 7e-4
"""Of the indenter, and of the indentations, m."""


class Moved:
    """Centres given over time, and a displacement of all of them that is not known."""

    def __init__(self):
        self.columns = {"indenter_position": slice(0, 3)}
        self.labels = ("x", "y", "z")
        self.sigma = np.full(3, 6e-3)

    def centres(self, path, time, s):
        slopes = np.broadcast_to(np.eye(3), (len(time), 3, 3))
        return path.at(time)[0] + s, slopes

    def value(self, name, s):
        return 0.0


def shell(outer, wall):
    """A hollow sphere, radius and wall in m."""
    inner = trimesh.creation.icosphere(3, outer - wall)
    inner.invert()
    return ms.Body("shell", trimesh.util.concatenate([trimesh.creation.icosphere(3, outer), inner]))


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_contacts_that_are_believed_inside_a_thin_wall_return_to_its_outer_side(seed):
    rng, body = np.random.default_rng(seed), shell(0.04, 4e-3)
    way = np.array([0.0, 0.0, 1.0]) + 0.5 * rng.normal(size=(80, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    truth = np.array([1e-3, -2e-3, 12e-3])
    time = np.arange(80.0)
    path = JointPath(time, (0.04 + RADIUS - DEPTH) * way - truth)
    heights = Heights(Moved(), path, time, body, RADIUS, np.full(80, DEPTH))
    found = heights.fit()
    np.testing.assert_allclose(found[:3], truth, atol=2e-4)
