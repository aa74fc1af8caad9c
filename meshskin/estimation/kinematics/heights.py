"""What the heights of the indenter over the body show of the robot's unknowns.

    h(c(s)) = R - exp(k) depth,    c(s): the indenter's centre by forward kinematics

In a contact the centre is as high over the believed surface as the radius of the indenter less the
depth of the indentation. Over a body that curves in several directions these heights determine most
offsets of the joints, the mount and the indenter's place. The rest are directions in which the
body slides along itself, which only the readings tell. The clock is left to them, too: a contact
that is held at a force keeps its height, and the noise of the joints' rates would pass for
information.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...contact import BATCHED, ContactModel
from ...core.arrays import Array, huber_cost, huber_weights, robust_sigma, sums_by_group
from ...core.errors import CalibrationError
from ...geometry.body import Body
from ...robot.contact_kinematics import JOINT_DELAY, JOINT_OFFSET, ContactKinematics, JointPath
from ...scene.belief import Belief
from ..data.registration import MIN_SCATTER, cells
from ..data.resolve_belief import nominal_patches
from .mesh_error import MeshError

MAX_ITERATIONS = 25
"""Largest number of damped Gauss-Newton steps. The heights are met within five; along directions
in which the body slides along itself, more steps do not help, but the readings."""
MAX_TRIALS = 12
"""Largest number of dampings of a step, each 10 times the last."""
CORRECTIONS = 2
"""Steps back to the heights after each step: where the body slides along itself they form a curved
valley, along which straight steps would be short."""
CONVERGED = 0.1
"""Length of the next step, in standard deviations, from which nothing moves that counts."""
FAR = 3e-4
"""Standard deviation of the heights, m, from which other starts are tried: half an indentation.
Errors of a mesh leave less; contacts on a wrong part of the body leave more."""
MAX_SCATTER = 3e-3
"""Largest standard deviation of the heights, m, of a body that is where it is believed: more than
the depth of an indentation."""
STROKE = 2.0
"""Time, s, in which the force of a touch is alike. Chosen: that of a stroke; controllers of a force
correct it within a second."""
LOG_DEPTH = 0.7
"""Standard deviation of the logarithm of the depths: that of E* within a factor e, as
`PRIORS["modulus"]`, of which the depth is the power -2/3."""


@dataclass(frozen=True)
class LinearizedHeights:
    """The unknowns by the heights, linear about a point, and by what was known before."""

    mean: Array
    """(K,)."""
    covariance: Array
    """(K, K)."""
    residuals: Array
    """Heights (m,), m, over those of a contact, at the point."""

    @property
    def root(self) -> Array:
        """(K, K) with root root^T the covariance."""
        value, vector = np.linalg.eigh(self.covariance)
        return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


@dataclass(frozen=True)
class Heights:
    """The heights of m contacts as functions of x (K + 1,): the unknowns of the robot, and the
    logarithm of the factor of all depths."""

    model: ContactKinematics
    path: JointPath
    """The joint angles."""
    time: Array
    """Times (m,), s, of the contacts."""
    body: Body
    radius: float
    """Radius of the indenter, m."""
    depth: Array
    """Depths (m,), m, of the indentations by the believed material."""
    mesh_error: MeshError = field(default_factory=MeshError)
    """Error of the body's surface."""
    touch: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Number (m,) of the touch of each contact; empty: each contact is a touch of its own."""

    @property
    def precision(self) -> Array:
        """Precisions (K + 1,) of x before any measurement."""
        return np.append(self.model.sigma, LOG_DEPTH) ** -2.0

    def residuals(self, x: Array) -> tuple[Array, Array, Array]:
        """Heights (m,), m, over those of a contact, their derivatives (m, K + 1), and the contact
        points (m, 3), m."""
        s, columns = x[:-1], self.model.columns
        centres, slopes = self.model.centres(self.path, self.time, s)
        height, points, normals = surface_heights(self.model, self.body, centres, s)
        sunk = np.exp(x[-1]) * self.depth
        jacobian = np.empty((len(centres), len(x)))
        jacobian[:, :-1] = np.einsum("mi,mik->mk", normals, slopes)
        jacobian[:, -1] = sunk
        if "clock_offset" in columns:
            jacobian[:, columns["clock_offset"]] = 0.0
        if "indenter_radius" in columns:
            jacobian[:, columns["indenter_radius"]] = -1.0
        if "mesh_scale" in columns:
            outward = np.einsum("mi,mi->m", normals, points)
            jacobian[:, columns["mesh_scale"]] = -outward[:, None]
        radius = self.radius + self.model.value("indenter_radius", s)
        return height - (radius - sunk), jacobian, points

    def fit(self, start: Array | None = None) -> Array:
        """x (K + 1,) that meets the heights, from a start, by default zero.

        Raises CalibrationError for heights that no x within its priors meets, and for indentations
        deeper than the indenter's radius.
        """
        x = self._descended(np.zeros(len(self.precision)) if start is None else start)
        if _scatter(self.residuals(x)[0]) > FAR:
            x = min(
                (x, *map(self._descended, self._aside())),
                key=lambda found: _scatter(self.residuals(found)[0]),
            )
        r = self.residuals(x)[0]
        if (scatter := _scatter(r)) > MAX_SCATTER:
            raise CalibrationError(
                "the contacts that follow from the joint angles are not on the body",
                value=f"{1e3 * scatter:.3g} mm off it",
                limit=f"{1e3 * MAX_SCATTER:g} mm",
                remedy="check the body's link and mount, the indenter's place, units and clocks",
            )
        if (sunk := float(np.median(np.exp(x[-1]) * self.depth))) > self.radius:
            raise CalibrationError(
                "the contacts that follow from the joint angles are deeper than the indenter",
                value=f"{1e3 * sunk:.3g} mm",
                limit=f"its radius, {1e3 * self.radius:g} mm",
                remedy="check the indenter's place and radius, and the body's mount and scale",
            )
        return x

    def _aside(self) -> Array:
        """Other starts (2, K + 1): one standard deviation from zero, to both sides, along the
        direction that moves the heights most. Contacts that are believed a radius too deep are on
        the other side of a thin wall, or below a crease, from where the fit does not return."""
        sigma = self.precision**-0.5
        slopes = self.residuals(np.zeros(len(sigma)))[1] * sigma
        most = np.linalg.svd(slopes, full_matrices=False)[2][0]
        return np.array([sigma * most, -sigma * most])

    def _descended(self, x: Array) -> Array:
        """x (K + 1,) of least cost, by steps from a start."""
        prior = self.precision
        pulls = prior.copy()
        if "clock_offset" in self.model.columns:
            pulls[self.model.columns["clock_offset"]] = 0.0  # heights leave the clock as it is
        (r, jacobian, points), damping = self.residuals(x), 1e-3
        for _ in range(MAX_ITERATIONS):
            scatter = _scatter(r)
            weight, alike = self._weights(r, jacobian, points)
            hessian = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
            gradient = jacobian.T @ (weight * r) + pulls * x
            if gradient @ np.linalg.solve(hessian, gradient) < CONVERGED**2:
                break
            cost = huber_cost(r / scatter) / alike + float(prior @ x**2) / 2
            for _ in range(MAX_TRIALS):
                step = -np.linalg.solve(hessian + damping * np.diag(prior), gradient)
                trial, found = self._corrected(x + step, r + jacobian @ step, weight)
                if huber_cost(found[0] / scatter) / alike + float(prior @ trial**2) / 2 < cost:
                    x, (r, jacobian, points), damping = trial, found, damping / 10
                    break
                damping *= 10
            else:
                break  # no step decreases the cost
        return x

    def _corrected(
        self, x: Array, expected: Array, weight: Array
    ) -> tuple[Array, tuple[Array, Array, Array]]:
        """x (K + 1,) moved as little as brings the residuals to those `expected` (m,), m, and the
        residuals there."""
        found = self.residuals(x)
        for _ in range(CORRECTIONS):
            r, slope, _ = found
            normal = slope.T @ (weight[:, None] * slope) + np.diag(self.precision)
            x = x - np.linalg.solve(normal, slope.T @ (weight * (r - expected)))
            found = self.residuals(x)
        return x, found

    def _weights(self, r: Array, jacobian: Array, points: Array) -> tuple[Array, float]:
        """Precisions (m,), 1/m^2, of the heights with residuals r (m,) and derivatives `jacobian`
        (m, K + 1), and their design effect, by which these are divided.

        Residuals are alike in a cell of the body by errors of its surface, and in a stroke by its
        force. The fit takes up as many strokes as it determines unknowns.
        """
        weight, strokes = huber_weights(r, _scatter(r)), self._strokes
        alike = max(design_effect(group, weight * r) for group in (cells(points), strokes))
        if free := self._free_strokes(weight, jacobian):
            count = int(strokes.max()) + 1
            alike = max(alike, design_effect(strokes, weight * r) * count / free)
        return weight / alike, alike

    @cached_property
    def _strokes(self) -> np.ndarray:
        """Number (m,) of the stroke of each contact: a touch is several if it is longer than
        STROKE; each contact is its own where the touches are not given."""
        if not len(self.touch):
            return np.arange(len(self.time))
        begin = np.full(int(self.touch.max()) + 1, np.inf)
        np.minimum.at(begin, self.touch, self.time)
        part = (self.time - begin[self.touch]) // STROKE
        pairs = np.column_stack([self.touch, part])
        return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].ravel())

    def _free_strokes(self, weight: Array, jacobian: Array) -> float:
        """Strokes less the unknowns that heights of precisions `weight` (m,) and derivatives
        `jacobian` (m, K + 1) determine; 0 where that leaves less than half of the strokes, whose
        residuals do not show the errors that they share."""
        data, count = jacobian.T @ (weight[:, None] * jacobian), int(self._strokes.max()) + 1
        free = count - float(np.trace(np.linalg.solve(data + np.diag(self.precision), data)))
        return free if free > count / 2 else 0.0

    def with_depth(self, s: Array) -> Array:
        """x (K + 1,) of the unknowns s (K,) with the depths that they leave to the contacts."""
        r = self.residuals(np.append(s, 0.0))[0]
        factor = np.median((self.depth - r) / self.depth)
        return np.append(s, np.log(np.clip(factor, *np.exp([-3 * LOG_DEPTH, 3 * LOG_DEPTH]))))

    def linearized(self, x: Array) -> LinearizedHeights:
        """The unknowns by heights that are linear about x (K + 1,).

        Residuals that are alike in a cell of the body, or in a stroke, count as fewer, and those in
        a cell share the error of the mesh. Delays that change the heights by less than MIN_SCATTER
        in their standard deviations stay as they were known before: errors that many heights share
        would pass for information.
        """
        r, jacobian, points = self.residuals(x)
        weight, count = self._weights(r, jacobian, points)[0], len(x) - 1
        weighted = self.mesh_error.without(points, weight, jacobian)
        hessian = jacobian.T @ weighted + np.diag(self.precision)
        gradient = weighted.T @ r + self.precision * x
        delays = np.arange(len(x))[self.model.columns.get(JOINT_DELAY, slice(0))]
        effect = np.sqrt(np.mean(jacobian[:, delays] ** 2, axis=0) / self.precision[delays])
        if len(weak := delays[effect < MIN_SCATTER]):
            share = np.linalg.solve(hessian[np.ix_(weak, weak)], hessian[weak])
            gradient = gradient - share.T @ gradient[weak]
            hessian = hessian - share.T @ hessian[weak]
            gradient[weak] = self.precision[weak] * x[weak]
            hessian[weak, weak] = self.precision[weak]
        mean = np.asarray(x - np.linalg.solve(hessian, gradient), dtype=float)
        covariance = np.asarray(np.linalg.inv(hessian), dtype=float)
        return LinearizedHeights(mean[:count], covariance[:count, :count], r)


def timed_by_the_fastest(
    model: ContactKinematics, path: JointPath, time: Array, body: Body
) -> ContactKinematics:
    """The kinematics with delays of all joints but the one that moves the heights at times (m,), s,
    fastest: delays of the others and of the clock are relative to its stamps, which determine most.
    Unchanged where the joints that are delayed are given."""
    names = model.chain.joint_names
    if model.delayed is not None or JOINT_DELAY not in model.columns or len(names) < 2:
        return model
    offsets = replace(model, unknown={JOINT_OFFSET: 1.0})
    centres, slopes = offsets.centres(path, time, np.zeros(len(names)))
    by_joint = np.einsum("mi,mij->mj", body.closest(centres).normal, slopes)
    fastest = int(np.argmax(np.sum((by_joint * path.at(time)[1]) ** 2, axis=0)))
    return replace(model, delayed=names[:fastest] + names[fastest + 1 :])


def depths(belief: Belief, curvature: Array, force: Array) -> Array:
    """Depths (m,), m, of contacts at curvatures (m, 2), 1/m, under forces (m,), N."""
    material = belief.material
    name = belief.contact if belief.contact in BATCHED else "elliptic"
    model = ContactModel(name, material.poisson, material.thickness)
    return np.asarray(nominal_patches(model, belief, force, curvature).depth)


def surface_heights(
    model: ContactKinematics, body: Body, centres: Array, s: Array
) -> tuple[Array, Array, Array]:
    """Signed heights (m,), m, of `centres` (m, 3) over the body at its scale of s (K,), with the
    closest points (m, 3) and normals there."""
    scale = float(np.exp(model.value("mesh_scale", s)))
    hit = body.closest(centres / scale)
    return scale * hit.distance, scale * hit.point, hit.normal


def _scatter(r: Array) -> float:
    """Robust standard deviation, m, of residuals (m,), m."""
    return max(robust_sigma(r), MIN_SCATTER)


def design_effect(group: np.ndarray, residuals: Array) -> float:
    """Variance of the mean of residuals (m,) that are alike in a group (m,), in relation to that of
    independent ones; at least 1."""
    sums = sums_by_group(residuals, group)
    return max(1.0, float(np.sum(sums**2) / max(np.sum(residuals**2), 1e-300)))
