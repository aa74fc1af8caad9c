"""Motions of all contact points along which the believed surface does not change.

A displacement along a cylinder, or a turn about its axis, moves contact points along the surface:
their distances from it stay, and so do the readings, which know the taxels by the contacts alone.
If the body's pose is wrong so, the whole map is displaced, and nothing in the log shows it.
"""

from __future__ import annotations

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ..data.measurements import Measurements
from .contact_errors import SHIFT_SIGMAS, displacement, effective_variance

LARGE = 0.3e-3
"""Motion of the contact points, m rms, that is named if it is within SHIFT_SIGMAS of chance: a
larger error makes a map useless."""
TURNED = 0.01
"""Largest part of a motion that is a turn, up to which the motion is called a displacement."""


def unseen_motions(data: Measurements) -> tuple[str, ...]:
    """The motions of all contact points that the distances from the believed surface do not show,
    in words; none where motions are estimated."""
    names = data.parameters.names
    if data.parameters.motion is not None or "body_offset" in names or len(data.points) < 6:
        return ()
    hit = data.body.closest(data.points)
    left = hit.distance - hit.normal @ displacement(hit.distance, hit.normal)
    variance = effective_variance(left, data.points)
    words = [_in_words(*motion) for motion in _motions(data.points, hit.normal, variance)]
    if not words:
        return ()
    return (
        f"the believed surface does not show {', '.join(words)} of all contact points: if the "
        "body's pose was wrong by it, the whole map is displaced by as much",
    )


def _motions(points: Array, normals: Array, variance: float) -> list[tuple[Array, Array, Array]]:
    """Motions of points (m, 3), m, that independent errors of `variance`, m^2, of their distances
    from a surface with normals (m, 3) hide: axis of the turn (3,), zero for a displacement;
    direction (3,) of that; point (3,), m, of the axis."""
    middle, m = points.mean(axis=0), len(points)
    arm = points - middle
    size = float(np.sqrt(np.mean(np.sum(arm**2, axis=1))))
    unit = np.broadcast_to(np.eye(3), (m, 3, 3))
    moved = np.concatenate([unit, -se3.hat(arm) / size], axis=2)
    mass = np.einsum("mia,mib->ab", moved, moved) / m
    columns = np.einsum("mi,mia->ma", normals, moved)
    value, vectors = np.linalg.eigh(mass)
    root = vectors / np.sqrt(np.maximum(value, 1e-9 * value[-1]))  # motions of 1 m rms
    value, vectors = np.linalg.eigh(root.T @ columns.T @ columns @ root)
    hidden = SHIFT_SIGMAS**2 * variance > LARGE**2 * value
    basis = (root @ vectors)[:, hidden]
    if not basis.shape[1]:
        return []
    by_turn = np.einsum("mia,aq->miq", moved[:, :, 3:], basis[3:]).reshape(-1, basis.shape[1])
    size_of_turn, mixed = np.linalg.eigh(by_turn.T @ by_turn / m)
    found = []
    for turn, x in zip(size_of_turn, (basis @ mixed).T, strict=True):
        shift, axis = x[:3], x[3:] / size
        if turn <= TURNED**2:
            found.append((np.zeros(3), shift / np.linalg.norm(shift), middle))
        else:
            about = middle + np.cross(axis, shift) / float(axis @ axis)
            found.append((axis / np.linalg.norm(axis), np.zeros(3), about))
    return found


def _in_words(axis: Array, direction: Array, about: Array) -> str:
    def vector(x: Array, digits: int) -> str:
        return "(" + ", ".join(f"{value + 0.0:g}" for value in np.round(x, digits)) + ")"

    def unsigned(x: Array) -> str:
        return vector(np.sign(x[np.argmax(np.abs(x))]) * x, 2)

    if not axis.any():
        return f"a displacement along {unsigned(direction)}"
    return f"a turn about {unsigned(axis)} through {vector(1e3 * about, 1)} mm"
