"""A context and frames for the tests of effects."""

import itertools

import numpy as np
import pytest

from meshskin.core.se3 import exp_so3
from meshskin.effects.frames import Frames


@pytest.fixture(scope="session")
def context(sphere):
    """The paper's sphere, seed 3."""
    return sphere.context(3)


@pytest.fixture(scope="session")
def glide(sphere):
    """frames(arc, period): contacts on the bottom of the sphere along the x axis at arc (m,), m."""

    def frames(arc, period=0.01, force=3.0, q=None):
        arc = np.asarray(arc, dtype=float)
        rotation = exp_so3(np.outer(arc / 0.1, [0.0, -1.0, 0.0]))
        normals = rotation @ [0.0, 0.0, -1.0]
        m = len(arc)

        def closest_point(centres):
            hit = sphere.body.exact.closest(centres)
            return hit.point, hit.normal

        return Frames(
            time=period * np.arange(m),
            points=0.1 * normals,
            normals=normals,
            force=np.broadcast_to(force, m).astype(float),
            centres=(0.1 + sphere.indenter.radius - sphere.patch.depth) * normals,
            curvature=np.full((m, 2), 10.0),
            directions=sphere.body.exact.closest(normals).direction,
            q=np.zeros((m, 6)) if q is None else q,
            closest_point=closest_point,
        )

    return frames


@pytest.fixture(scope="session")
def split():
    """split(act, frames, pressures): outputs of a stateful function called with three batches."""

    def run(act, frames, pressures=None):
        seams = [0, 1, len(frames) // 3, len(frames)]
        parts = []
        for start, end in itertools.pairwise(seams):
            rows = slice(start, end)
            if pressures is None:
                parts.append(act(frames.rows(rows)))
            else:
                parts.append(act(pressures[rows], frames.rows(rows)))
        return parts

    return run
