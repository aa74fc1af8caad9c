"""Joint maximum likelihood: all readings of all contacts, every unknown at once.

Unknown are two coordinates of every taxel in a chart of the surface, or the poses of rigid modules,
gains and offsets where declared, and what all share (E*, force, indenter, body). The taxels are
eliminated from the shared unknowns (eliminate.py), which IPOPT finds (solve.py). Charts and
contacts are anchored anew at the solution until nothing moves, so that all end on the surface. The
Hessian is Gauss-Newton throughout: the exact one finds wrong optima from starts as near as 0.7 mm.
IPOPT's status is not believed: the Newton decrement and every taxel's chi-square are, and a taxel
that misfits is started again from the centroid of its contacts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ...core.errors import CalibrationError
from ...core.se3 import Array
from .. import chart
from ..data.measurements import Measurements
from ..trilateration import coactivation, trilaterate
from ..uncertainty.goodness_of_fit import GoodnessOfFit, goodness
from . import fault_detection, module_parametrization
from .joint_estimator import MAX_RELINEARIZATIONS, JointEstimator
from .newton import MAX_ITERATIONS, NEWTON_TOLERANCE
from .null_space import undetermined
from .outlier_rejection import reject_outliers
from .parametrization import Parametrization, SurfaceParametrization
from .pressure import CENSORED, OBSERVED

if TYPE_CHECKING:
    from ...geometry.body import Body

UNCONVERGED = "no place where it comes to rest"
"""Why a taxel is not determined though its trilateration is."""
MOSTLY_OUTLIERS = "most of its readings are outlying"
"""Why a taxel is not believed; what they show is in its fault."""


@dataclass(frozen=True)
class Joint:
    """The joint estimate of n taxels; entries of taxels that are not determined are NaN or inf."""

    points: Array
    """(n, 3) on the surface, body frame, m."""
    rotations: Array
    """Frames (n, 3, 3), z the outward normal, or the module's z axis; of a taxel by itself the spin
    is a convention."""
    covariance: Array
    """(n, 2, 2) in the tangent plane, m^2, all else being unknown too."""
    covariances: Array | None
    """(n, 6, 6) of the poses in the taxels' frames, where modules are rigid."""
    shared: Array
    """The shared unknowns (ks,), as `data.shared` orders them."""
    shared_covariance: Array
    """(ks, ks)."""
    undetermined: tuple[str, ...]
    """Directions of the shared unknowns that the readings leave to the priors, in words."""
    extras: Array
    """ln gain and offset (Pa) of each taxel (n, extras), as far as they are declared."""
    extras_sigma: Array
    """Their standard deviations (n, extras)."""
    chi2: Array
    """Of the readings of each taxel, per degree of freedom (n,)."""
    reasons: np.ndarray
    """Why a taxel is not determined (n,); "" where it is."""
    faults: np.ndarray
    """What is wrong with a taxel (n,); "" where nothing was found."""
    fit: GoodnessOfFit
    """Whether model and readings agree."""
    iterates: tuple[Array, ...]
    """Points (n, 3) along the way, the start first."""
    restarted: np.ndarray
    """Rows of taxels that were started again."""
    data: Measurements
    """What was estimated from."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of choosing the readings, of settling and solving, and of all."""

    @property
    def unknowns(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each shared unknown, as `data.shared` labels them."""
        sigma = np.sqrt(np.diag(self.shared_covariance))
        values = zip(self.data.shared.labels, self.shared, sigma, strict=True)
        return {label: (float(value), float(deviation)) for label, value, deviation in values}

    @property
    def modulus(self) -> float:
        """E*, Pa."""
        return self.data.modulus * float(np.exp(self.data.shared.value("modulus", self.shared)))

    @property
    def modulus_sigma(self) -> float | None:
        """Its standard deviation, Pa; None where it was not estimated."""
        columns = self.data.shared.columns
        if "modulus" not in columns:
            return None
        k = columns["modulus"].start
        return self.modulus * float(np.sqrt(self.shared_covariance[k, k]))


def estimate(
    data: Measurements,
    body: Body,
    start: trilaterate.Fit | None = None,
    iterations: int = MAX_ITERATIONS,
    tolerance: float = NEWTON_TOLERANCE,
) -> Joint:
    """The most likely unknowns, from trilateration as a start, or co-activation where it fails.

    `iterations`: the most that IPOPT may take; `tolerance`: the Newton decrement at which
    taxels and shared unknowns are at the optimum, in units of the cost. Raises CalibrationError if
    no taxel is determined or the optimiser does not converge, ContactError where what it finds
    leaves the contact model.
    """
    clock = time.perf_counter()
    near = coactivation.without_distant_readings(data)
    start = start or coactivation.initial_estimate(near, body)
    heard = coactivation.responsive(data, start.points)
    why = np.where(start.found & ~heard, coactivation.NOISE, start.reasons)
    stuck = fault_detection.stuck_taxels(data)
    live = np.setdiff1d(np.flatnonzero(why == ""), stuck.rows)
    if not len(live):
        raise CalibrationError(
            "no taxel is determined by the recording",
            value=", ".join(sorted(set(map(str, why)))),
            remedy="touch every taxel from at least three contacts that are not on a line",
        )
    step = float(np.median(data.radii)) / 2
    places: Parametrization
    if data.slots is None:
        places = SurfaceParametrization(
            chart.charts_at(body, start.points[live], start.rotations[live]), step
        )
    else:
        sound = np.isin(np.arange(len(data.ids)), live)
        places, live = module_parametrization.start(
            body, data.slots, data.ids, start.points, sound, step
        )
    weight = np.where(np.isin(data.taxel, stuck.rows), 0.0, 1.0)
    run = JointEstimator(data, body, live, places, weight, iterations, tolerance)
    run.converge()
    again = run.restart(trilaterate.centroids(near, body)[live])
    run = reject_outliers(run)
    for row, level in zip(stuck.rows, stuck.level, strict=True):
        run.faults[row] = f"stuck at {level / 1e3:.3g} kPa"
    if run.unconverged.all():
        raise CalibrationError(
            "the joint estimate does not come to rest",
            value=f"{len(live)} taxels still move after {MAX_RELINEARIZATIONS} anchorings",
            remedy="check the contact model and the units of force and pressure",
        )
    return _result(run, why, again, clock)


def _fit(run: JointEstimator, own: Array) -> GoodnessOfFit:
    """The chi-square test on readings that the model puts well inside the sensor's range.

    The choice is the model's, not the reading's, so that the residuals are not censored. Each keeps
    1 less its leverage `own` (k,) of the noise.
    """
    read, data = run.likelihood.readings, run.data
    r = run.residuals()
    mu = r + np.where(read.kind == CENSORED, data.threshold, read.level) / data.sigma
    clear = (mu > data.threshold / data.sigma + 3) & (mu < data.saturation / data.sigma - 3)
    clear &= ~run.broken[read.taxel]
    return goodness(
        float(read.weight[clear] @ r[clear] ** 2), float(np.sum((read.weight - own)[clear])),
        bool(data.noise), int(np.sum(fault_detection.outliers(read))),
    )  # fmt: skip


def _result(run: JointEstimator, why: np.ndarray, again: np.ndarray, clock: float) -> Joint:
    """What was found, of all taxels."""
    data, problem, state = run.data, run.problem, run.state
    problem.contacts.check(state.s)

    def spread(values: Array, missing: object) -> Array:
        out = np.empty((len(data.ids), *values.shape[1:]))
        out[:] = missing
        out[run.live] = values
        return out

    reduced = problem.reduce(state)
    covariance, shared = problem.covariances(state, reduced)
    places, why = problem.parametrization, why.copy()
    why[run.live] = ""
    lost = run.unconverged | run.broken
    why[run.live[run.broken]] = MOSTLY_OUTLIERS
    why[run.live[run.unconverged]] = UNCONVERGED
    points = np.where(lost[:, None], np.nan, places.points())
    chi2, own = run.chi2, problem.leverages(state, reduced)
    kept = run.likelihood.readings.weight - own
    freedom = float(kept[run.likelihood.readings.kind == OBSERVED].sum())
    scale = 1.0 if data.noise else float(state.moments.square.sum()) / max(freedom, 1.0)
    information, gains = problem.information(state)
    groups = np.arange(places.count)
    six, tangential = None, scale * covariance[:, :2, :2]
    if isinstance(places, module_parametrization.ModuleParametrization):
        six = scale * places.covariances(covariance[:, :6, :6])
        tangential = six[:, :2, :2]
        six = spread(
            np.where(lost[:, None, None], np.diag([np.inf] * 6), six), np.diag([np.inf] * 6)
        )
    tangential = np.where(lost[:, None, None], np.diag([np.inf] * 2), tangential)
    sigma = np.sqrt(scale * np.diagonal(covariance, axis1=1, axis2=2))
    unit = [data.sigma if name == "offset" else 1.0 for name in data.shared.local_names]

    return Joint(
        points=spread(points, np.nan),
        rotations=spread(places.rotations(), np.nan),
        covariance=spread(tangential, np.diag([np.inf, np.inf])),
        covariances=six,
        shared=state.s,
        shared_covariance=scale * shared,
        undetermined=undetermined(data.shared, information / scale, gains),
        extras=spread(problem.extras(state.z, groups) * unit, np.nan),
        extras_sigma=spread(problem.extras(sigma, groups) * unit, np.inf),
        chi2=spread(chi2 / scale, np.nan),
        reasons=why,
        faults=run.faults,
        fit=_fit(run, own),
        iterates=tuple(spread(p, np.nan) for p in run.iterates),
        restarted=run.live[again],
        data=data,
        seconds=run.seconds | {"joint": time.perf_counter() - clock},
    )
