"""A context and frames that the effects are tried on."""

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
    """frames(way, period): contacts on the sphere's bottom, along the x axis at way (m,), m."""

    def frames(way, period=0.01, force=3.0, q=None):
        way = np.asarray(way, dtype=float)
        turn = exp_so3(np.outer(way / 0.1, [0.0, -1.0, 0.0]))
        normals = turn @ [0.0, 0.0, -1.0]
        m = len(way)

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
    """split(act, *rows, frames): what a stateful function gives when fed in three batches."""

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
