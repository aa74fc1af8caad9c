"""A declared offset of the body by the distances of the contact points from its surface.

Contact points are on the surface of the body at its true place. Over a body that curves in several
directions their distances determine most of an unknown offset, which readings hardly do: taxels
move with it. Where the body slides along itself, as a ball does that turns about its centre,
nothing tells the offset: contacts and taxels move over the body together, and all readings stay.
Such directions are held at their prior mean and named as undetermined. Whether a taxel is
determined is then a statement about its place among the contacts, in the recorded frame; its
covariance is that of its place on the body, with the prior variance of the held directions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import se3
from ...core.arrays import Array, huber_weights, robust_sigma
from ...scene.belief import Belief
from ...scene.contact_motion import ContactMotion
from .global_parameters import declared_parameters

ITERATIONS = 30
"""Largest number of Gauss-Newton steps; 5 to 10 are usual for offsets of millimetres."""
CONVERGED = 1e-3
"""Length of a step, in standard deviations, from which nothing moves."""
MIN_SCATTER = 1e-5
"""Least standard deviation of a distance, m: no arm and no mesh is better."""
CELL = 0.01
"""Size, m, of cells of the body in which all contacts together count as one: dents of a mesh are as
wide as this and more."""
UNDETERMINED = 0.5
"""Part of the prior variance of a direction of the offset that the distances leave, from which the
direction is held: the prior then tells more than they do."""


def registered(
    belief: Belief, points: Array, used: np.ndarray | slice = slice(None)
) -> tuple[Belief, Array]:
    """The belief with the body offset as a contact motion about its value by the distances, and the
    contact points (m, 3), m, body frame, moved there.

    used (m,) bool: the points that touch the body, whose distances count; by default all.

    Both as they are where no body offset is unknown, where the belief has another contact motion,
    where no point touches, and where the points are on the surface: they were computed from it,
    wherever the body was.
    """
    if "body_offset" not in belief.unknown or belief.contact_motion is not None:
        return belief, points
    touching = points[used]
    if not len(touching):
        return belief, points
    if np.median(np.abs(belief.body.closest(touching).distance)) < MIN_SCATTER:
        return belief, points
    declared = declared_parameters(("body_offset",), belief.priors, 1.0, 1.0)
    offset, covariance = _fit(belief, touching, declared.sigma)
    moved = _moved(points, offset)
    centres = moved + belief.indenter.radius * belief.body.closest(moved).normal
    value, vectors = np.linalg.eigh(covariance / np.outer(declared.sigma, declared.sigma))
    root = declared.sigma[:, None] * vectors * np.sqrt(np.maximum(value, 0.0))
    motion = ContactMotion(
        labels=declared.labels,
        sigma=declared.sigma,
        slopes=slopes(centres, offset),
        mean=offset,
        root=root[:, value < UNDETERMINED],
        held=root[:, value >= UNDETERMINED],
    )
    unknown = tuple(name for name in belief.unknown if name != "body_offset")
    return replace(belief, unknown=unknown, contact_motion=motion), moved


def slopes(moved: Array, offset: Array) -> Array:
    """Derivatives (m, 3, 6) by an offset (6,), m and rad, of points (m, 3), m, that it moved."""
    arms = -se3.hat(moved - offset[:3]) @ se3.left_jacobian(offset[3:])
    return np.concatenate([np.broadcast_to(np.eye(3), arms.shape), arms], axis=2)


def _moved(points: Array, offset: Array) -> Array:
    """Points (m, 3), m, moved by an offset (6,), m and rad, as the joint estimate moves them."""
    return np.asarray(points @ se3.exp_so3(offset[3:]).T + offset[:3])


def cells(points: Array, size: float = CELL) -> np.ndarray:
    """Number (m,) of the cell of the body, of a size in m, of each of the points (m, 3), m."""
    return np.asarray(np.unique(np.floor(points / size), axis=0, return_inverse=True)[1].ravel())


def _fit(belief: Belief, points: Array, sigma: Array) -> tuple[Array, Array]:
    """The most likely offset (6,), m and rad, with standard deviations sigma (6,) before, and its
    covariance (6, 6)."""
    offset, prior = np.zeros(6), sigma**-2
    for _ in range(ITERATIONS):
        moved = _moved(points, offset)
        hit = belief.body.closest(moved)
        scatter = max(robust_sigma(hit.distance), MIN_SCATTER)
        scatter = float(np.hypot(scatter, belief.surface_sigma))
        weight = huber_weights(hit.distance, scatter)
        cell = cells(moved)
        weight /= np.bincount(cell)[cell]
        jacobian = np.einsum("mi,mik->mk", hit.normal, slopes(moved, offset))
        hessian = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
        gradient = jacobian.T @ (weight * hit.distance) + prior * offset
        step = -np.linalg.solve(hessian, gradient)
        offset = offset + step
        if step @ hessian @ step < CONVERGED**2:
            break
    return offset, np.asarray(np.linalg.inv(hessian))
