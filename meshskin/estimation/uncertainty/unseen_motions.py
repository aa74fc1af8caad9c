"""Motions of all contact points along which the believed surface does not change.

A displacement along a cylinder, or a turn about its axis, moves contact points along the surface:
their distances from it stay, and so do the readings, which know the taxels by the contacts alone.
If the body's pose is wrong so, the whole map is displaced, and nothing in the log shows it. Nor
does anything where the contact points were projected on that surface.
"""

from __future__ import annotations

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.content_cache import cached_on_argument
from ..data.measurements import Measurements
from .contact_errors import SHIFT_SIGMAS, displacement, effective_variance, on_surface

LARGE = 0.3e-3
"""Motion of the contact points, m rms, that is named if it is within SHIFT_SIGMAS of chance: a
larger error makes a map useless."""
ON_SURFACE, MOST = 1e-6, 0.95
"""Distance, m, from the believed surface up to which points were computed on it, and the part of
them: measured ones lie some hundredths of a millimetre off."""
TURNED = 0.01
"""Largest part of a motion that is a turn, up to which the motion is called a displacement."""
MEET = 0.02
"""Distance of a point from axes that meet there, relative to its distance from the contacts: those
of a ball are within 1e-3 (test_a_ball_turns_about_its_middle)."""


@cached_on_argument
def unseen_motions(data: Measurements) -> tuple[str, ...]:
    """The motions of all contact points that the distances from the believed surface do not show,
    in words, and whether these can show anything; none where motions are estimated."""
    names = data.parameters.names
    if data.parameters.motion is not None or "body_offset" in names or len(data.points) < 6:
        return ()
    hit, _ = on_surface(data, data.points)
    left = hit.distance - hit.normal @ displacement(hit.distance, hit.normal)
    variance = effective_variance(left, data.points)
    found, motions = [], _motions(data.points, hit.normal, variance)
    if motions:
        words = ", ".join(_in_words(*motion) for motion in motions)
        if (centre := _common_centre(motions)) is not None:
            words = f"any turn about the point {_vector(1e3 * centre, 1)} mm"
        found.append(
            f"the believed surface does not show {words} of all contact points: if the body's pose "
            "was wrong by it, the whole map is displaced by as much"
        )
    stated = data.belief.surface_sigma > 0.0
    if not stated and np.quantile(np.abs(hit.distance), MOST) < ON_SURFACE:
        found.append(
            "the contact points were computed on the believed surface, as their distances from it "
            f"are below {1e6 * ON_SURFACE:g} um: no error of the body, of the skin's thickness or "
            "of the kinematics is tested or in the standard deviations; record points as measured, "
            "or state belief.surface_sigma"
        )
    return tuple(found)


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


def _common_centre(motions: list[tuple[Array, Array, Array]]) -> Array | None:
    """The point (3,), m, where the axes of three turns meet, as those of a ball do; else None."""
    axes, through = (np.array([motion[k] for motion in motions]) for k in (0, 2))
    if len(motions) != 3 or not axes.any(axis=1).all():
        return None
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    off = (across @ through[:, :, None])[..., 0]
    centre = np.linalg.solve(across.sum(axis=0), off.sum(axis=0))
    missed = np.linalg.norm((across @ centre) - off, axis=1).max()
    far = np.linalg.norm(centre - through, axis=1).max()
    return centre if missed <= MEET * far else None


def _vector(x: Array, digits: int) -> str:
    return "(" + ", ".join(f"{value + 0.0:g}" for value in np.round(x, digits)) + ")"


def _in_words(axis: Array, direction: Array, about: Array) -> str:
    def unsigned(x: Array) -> str:
        return _vector(np.sign(x[np.argmax(np.abs(x))]) * x, 2)

    if not axis.any():
        return f"a displacement along {unsigned(direction)}"
    return f"a turn about {unsigned(axis)} through {_vector(1e3 * about, 1)} mm"
