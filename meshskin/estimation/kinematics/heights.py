"""What the heights of the indenter over the body show of the robot's unknowns.

    h(c(s)) + l d = R - exp(k + e ln(F / F0)) depth,    c(s): the indenter's centre

In a contact the centre, by forward kinematics, is as high over the real surface as the radius of
the indenter less the depth of the indentation. The real surface is below the smooth one of a mesh
by a part l of the latter's height d over the faces: one part for all of a mesh, as exporters and
decimations treat its faces alike. Depths grow with the force by another exponent than the contact
model's: that of a thin layer is lower than that of a half-space.

Over a body that curves in several directions these heights determine most offsets of the joints,
the mount and the indenter's place. The rest are directions in which the body slides along itself,
which only the readings tell. The clock is left to them, too: a contact that is held at a force
keeps its height, and the noise of the joints' rates would pass for information.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...contact import BATCHED, ContactModel
from ...core.arrays import Array, huber_cost, huber_weights, robust_sigma, sums_by_group
from ...core.errors import CalibrationError
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ...robot.contact_kinematics import JOINT_DELAY, ContactKinematics, JointPath
from ...scene.belief import Belief
from ..data.registration import MIN_SCATTER, cells
from ..data.resolve_belief import nominal_patches
from .mesh_error import MeshError, over_faces

MAX_ITERATIONS = 25
"""Largest number of damped Gauss-Newton steps. The heights are met within five; along directions
in which the body slides along itself, more steps do not help, but the readings."""
MAX_TRIALS = 12
"""Largest number of dampings of a step, each 10 times the last."""
CORRECTIONS = 2
"""Steps back to the heights after each step: where the body slides along itself they form a curved
valley, along which straight steps would be short."""
SURFACE_STEPS = 4
"""Gauss-Newton steps of the entries of SURFACE alone: depths are exponential in one of them."""
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
LEAST_LEFT = 0.1
"""Part of the squares of errors that strokes share, that the residuals show at least: of smaller
ones, other errors are most of what they show."""
OFF = 10.0
"""Height of a contact over the others', in their standard deviations, from which it is off the
body; it is so by more than half an indentation, too."""
OFF_STROKE = 0.25
"""Part of the contacts of a stroke from which all are off the body: unknowns of the robot are
fitted to a fast one, and meet some of its heights."""
MOST_OFF = 0.1
"""Part of the contacts up to which they may be off the body: of more, the others may be wrong."""
LOG_DEPTH = 0.7
"""Standard deviation of the logarithm k of the depths: that of E* within a factor e, as
`PRIORS["modulus"]`, of which the depth is the power -2/3."""
EXPONENT = 0.2
"""Standard deviation of the exponent e of the force: Hertz' 2/3, 1/2 of springs, and 1/3 of a thin
incompressible layer (Johnson, "Contact Mechanics" (1985), sections 4.2, 4.3, 5.8) are within two.
"""
FLATNESS = 3**-0.5
"""Standard deviation of the part l of the height over the faces: that about 0, the smooth surface,
where l is uniform between 0 and 1."""
SURFACE = np.array([LOG_DEPTH, EXPONENT, FLATNESS])
"""Standard deviations of k, e, l: the last entries of x."""


@dataclass(frozen=True)
class LinearizedHeights:
    """The unknowns by the heights, linear about a point, and by what was known before."""

    mean: Array
    """(K,)."""
    covariance: Array
    """(K, K)."""

    @property
    def root(self) -> Array:
        """(K, K) with root root^T the covariance."""
        value, vector = np.linalg.eigh(self.covariance)
        return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


@dataclass(frozen=True)
class Heights:
    """The heights of m contacts as functions of x (K + 3,): the K unknowns of the robot, and those
    of SURFACE."""

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
    force: Array | float = 1.0
    """Forces (m,), N, of the contacts, or that of all."""
    off: int = 0
    """Number of contacts that were left out, off the body."""
    known: LinearizedHeights | None = None
    """What they tell about their own optimum. About where readings have moved the contacts, heights
    of other places would give another mean, nearer to there."""

    @property
    def precision(self) -> Array:
        """Precisions (K + 3,) of x before any measurement."""
        return np.append(self.model.sigma, SURFACE) ** -2.0

    def sunk(self, x: Array) -> Array:
        """Depths (m,), m, of the indentations at x (K + 3,)."""
        return np.asarray(np.exp(x[-3] + x[-2] * self._load) * self.depth)

    def on_body(self, x: Array) -> np.ndarray:
        """Contacts (m,) bool that are where the others lie on the body at x (K + 3,): something
        else pressed the skin in others, or the indenter beside it, or the path leads through the
        body. All where too many are not."""
        r, strokes = self.residuals(x)[0], self._strokes
        off = np.abs(r) > max(OFF * _scatter(r), float(np.median(self.sunk(x))) / 2)
        share = np.bincount(strokes, off) / np.bincount(strokes)
        off |= share[strokes] > OFF_STROKE
        return np.asarray(~off if np.mean(off) <= MOST_OFF else np.ones(len(r), dtype=bool))

    @cached_property
    def _load(self) -> Array | float:
        """Logarithms (m,) of the forces, or that of all, over the typical one."""
        return np.asarray(np.log(self.force / np.median(self.force)))

    def residuals(self, x: Array) -> tuple[Array, Array, Array]:
        """Heights (m,), m, over those of a contact, their derivatives (m, K + 3), and the contact
        points (m, 3), m."""
        s, columns = x[:-3], self.model.columns
        centres, slopes = self.model.centres(self.path, self.time, s)
        scale, hit = closest_at_scale(self.model, self.body, centres, s)
        points, sunk, over = scale * hit.point, self.sunk(x), scale * over_faces(self.body, hit)
        jacobian = np.empty((len(centres), len(x)))
        jacobian[:, :-3] = np.einsum("mi,mik->mk", hit.normal, slopes)
        jacobian[:, -3:] = np.column_stack([sunk, sunk * self._load, over])
        if "clock_offset" in columns:
            jacobian[:, columns["clock_offset"]] = 0.0
        if "indenter_radius" in columns:
            jacobian[:, columns["indenter_radius"]] = -1.0
        if "mesh_scale" in columns:
            outward = np.einsum("mi,mi->m", hit.normal, points)
            jacobian[:, columns["mesh_scale"]] = -outward[:, None]
        radius = self.radius + self.model.value("indenter_radius", s)
        return scale * hit.distance + x[-1] * over - (radius - sunk), jacobian, points

    def fit(self, start: Array | None = None) -> Array:
        """x (K + 3,) that meets the heights, from a start, by default zero.

        Raises CalibrationError for heights that no x within its priors meets, and for indentations
        deeper than the indenter's radius.
        """
        x = self._descended(np.zeros(len(self.precision)) if start is None else start)
        if _scatter(self.residuals(x)[0]) > FAR or np.median(self.sunk(x)) > self.radius:
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
        if (sunk := float(np.median(self.sunk(x)))) > self.radius:
            raise CalibrationError(
                "the contacts that follow from the joint angles are deeper than the indenter",
                value=f"{1e3 * sunk:.3g} mm",
                limit=f"its radius, {1e3 * self.radius:g} mm",
                remedy="check the indenter's place and radius, and the body's mount and scale",
            )
        return x

    def _aside(self) -> Array:
        """Other starts (2, K + 3): one standard deviation from zero, to both sides, along the
        direction that moves the heights most. Contacts that are believed a radius too deep are on
        the other side of a thin wall, or below a crease, from where the fit does not return."""
        sigma = self.precision**-0.5
        slopes = self.residuals(np.zeros(len(sigma)))[1] * sigma
        most = np.linalg.svd(slopes, full_matrices=False)[2][0]
        return np.array([sigma * most, -sigma * most])

    def _descended(self, x: Array) -> Array:
        """x (K + 3,) of least cost, by steps from a start."""
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
        """x (K + 3,) moved as little as brings the residuals to those `expected` (m,), m, and the
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
        (m, K + 3), and their design effect, by which these are divided.

        Residuals are alike in a cell of the body, as wide as a face, by errors of its surface, and
        in a stroke by its force. Of errors that strokes share, the fit takes up a part.
        """
        weight, strokes = huber_weights(r, _scatter(r)), self._strokes
        alike = design_effect(strokes, weight * r, self._hidden(weight, jacobian))
        alike = max(alike, design_effect(cells(points, self.mesh_error.cell), weight * r))
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

    def _hidden(self, weight: Array, jacobian: Array) -> float:
        """Squares of the errors that strokes share, in those that a fit by heights of precisions
        `weight` (m,) and derivatives `jacobian` (m, K + 3) leaves in their residuals."""
        weighted = weight[:, None] * jacobian
        shared = sums_by_group(weighted, self._strokes)
        normal = jacobian.T @ weighted + np.diag(self.precision)
        whole = np.bincount(self._strokes, weight)
        left = np.diag(whole) - shared @ np.linalg.solve(normal, shared.T)
        return 1 / max(float(np.sum(left**2) / np.sum(whole**2)), LEAST_LEFT)

    def with_surface(self, s: Array) -> Array:
        """x (K + 3,) of the unknowns s (K,) with the depths and the surface that they leave to the
        contacts."""
        x = np.append(s, np.zeros(3))
        for _ in range(SURFACE_STEPS):
            r, jacobian, points = self.residuals(x)
            weight, slope = self._weights(r, jacobian, points)[0], jacobian[:, -3:]
            hessian = slope.T @ (weight[:, None] * slope) + np.diag(SURFACE**-2)
            x[-3:] -= np.linalg.solve(hessian, slope.T @ (weight * r) + x[-3:] / SURFACE**2)
        return x

    def linearized(self, x: Array) -> LinearizedHeights:
        """The unknowns by heights that are linear about x (K + 3,).

        Residuals that are alike in a cell of the body, or in a stroke, count as fewer, and those in
        a cell share the error of the mesh. Delays that change the heights by less than MIN_SCATTER
        in their standard deviations stay as they were known before: errors that many heights share
        would pass for information.
        """
        r, jacobian, points = self.residuals(x)
        weight, count = self._weights(r, jacobian, points)[0], len(x) - 3
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
        return LinearizedHeights(mean[:count], covariance[:count, :count])


def depths(belief: Belief, curvature: Array, force: Array) -> Array:
    """Depths (m,), m, of contacts at curvatures (m, 2), 1/m, under forces (m,), N."""
    material = belief.material
    name = belief.contact if belief.contact in BATCHED else "elliptic"
    model = ContactModel(name, material.poisson, material.thickness)
    return np.asarray(nominal_patches(model, belief, force, curvature).depth)


def closest_at_scale(
    model: ContactKinematics, body: Body, centres: Array, s: Array
) -> tuple[float, Closest]:
    """The body's scale of s (K,), and what of the body as it is given is closest to `centres`
    (m, 3), m, over the scaled one."""
    scale = float(np.exp(model.value("mesh_scale", s)))
    return scale, body.closest(centres / scale)


def _scatter(r: Array) -> float:
    """Robust standard deviation, m, of residuals (m,), m."""
    return max(robust_sigma(r), MIN_SCATTER)


def design_effect(group: np.ndarray, residuals: Array, hidden: float = 1.0) -> float:
    """Variance of the mean of residuals (m,) that are alike in a group (m,), in relation to that of
    independent ones; at least 1.

    hidden: squares of the errors that groups share over those of the residuals that they leave.
    """
    sums = sums_by_group(residuals, group)
    return max(1.0, hidden * float(np.sum(sums**2) / max(np.sum(residuals**2), 1e-300)))
