"""Joint maximum likelihood: all readings of all contacts in one NLP, solved by IPOPT.

Unknown are two coordinates of every taxel in a chart of the surface, and ln E*, shared by all.
The charts are anchored anew at the solution until it no longer moves, so that every taxel ends on
the surface. The Hessian is Gauss-Newton throughout: the exact one finds wrong optima from starts as
near as 0.7 mm. IPOPT's status is not believed: the Newton decrement and every taxel's chi-square
are, and a taxel that misfits is started again from the centroid of its contacts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..errors import CalibrationError
from ..se3 import Array
from . import chart, trilaterate
from .chart import Charts
from .likelihood import Likelihood
from .measurements import Measurements

if TYPE_CHECKING:
    from ..geometry.body import Body

RESTLESS = "no place where it comes to rest"
"""Why a taxel is not determined though its trilateration is."""
PASSES = 8
"""Most anchorings of the charts; two or three are usual."""
STILL = 1e-9
"""Move of the taxels at which the anchoring ends, m."""
MODULUS_PRIOR = 1.0
"""Standard deviation of ln E* about its nominal value before any data."""
MISFIT = 4.0
"""Chi-square per degree of freedom, relative to the median's, that starts a taxel again."""
MISFIT_NOMINAL = 25.0
"""The same where the noise is not known: residuals of 5 % of the peak pressure."""


@dataclass(frozen=True)
class Joint:
    """The joint estimate of n taxels; entries of taxels that are not determined are NaN or inf."""

    points: Array
    """(n, 3) on the surface, body frame, m."""
    rotations: Array
    """Frames (n, 3, 3), z the outward normal; the spin is a convention."""
    covariance: Array
    """(n, 2, 2) in the tangent plane, m^2, E* being unknown too."""
    modulus: float
    """E*, Pa."""
    modulus_sigma: float
    """Its standard deviation, Pa."""
    chi2: Array
    """Of the readings of each taxel, per degree of freedom (n,)."""
    why: np.ndarray
    """Why a taxel is not determined (n,); "" where it is."""
    iterates: tuple[Array, ...]
    """Points (n, 3) along IPOPT's iterations, the start first."""
    restarted: np.ndarray
    """Rows of taxels that were started again."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of building, solving and checking."""


def estimate(data: Measurements, body: Body, start: trilaterate.Fit | None = None) -> Joint:
    """The most likely taxel positions and E*, from the least-squares trilateration as a start.

    Raises CalibrationError if no taxel is determined or the optimiser does not converge.
    """
    clock = time.perf_counter()
    start = start or trilaterate.least_squares(data, body)
    live = np.flatnonzero(start.found)
    if not len(live):
        raise CalibrationError(
            "no taxel is determined by the recording",
            value=", ".join(sorted(set(map(str, start.why)))),
            remedy="touch every taxel from at least three contacts that are not on a line",
        )
    run = _Run(data, body, live)
    charts = chart.about(body, start.points[live], start.rotations[live])
    charts, e = run.converge(charts, 0.0)
    charts, e, again = _restart(run, charts, e)
    if run.restless.all():
        raise CalibrationError(
            "the joint estimate does not come to rest",
            value=f"{len(live)} taxels still move after {PASSES} anchorings",
            remedy="check the contact model and the units of force and pressure",
        )
    normal = run.likelihood.normal(charts, e)
    covariance, variance_e = normal.covariance()
    covariance[run.restless] = np.diag([np.inf, np.inf])
    why = start.why.copy()
    why[live[run.restless]] = RESTLESS
    points = np.where(run.restless[:, None], np.nan, charts.points)
    chi2 = normal.chi2
    scale = 1.0 if data.noise else float(np.sum(normal.cost2)) / max(normal.freedom, 1)
    modulus = data.modulus * float(np.exp(e))
    return Joint(
        points=_spread(points, live, data, np.nan),
        rotations=_spread(trilaterate.frames_of(charts), live, data, np.nan),
        covariance=_spread(scale * covariance, live, data, np.diag([np.inf, np.inf])),
        modulus=modulus,
        modulus_sigma=modulus * float(np.sqrt(scale * variance_e)),
        chi2=_spread(chi2 / scale, live, data, np.nan),
        why=why,
        iterates=tuple(_spread(p, live, data, np.nan) for p in run.iterates),
        restarted=live[again],
        seconds=run.seconds | {"joint": time.perf_counter() - clock},
    )


@dataclass
class _Run:
    """One estimation under way: the likelihood for the charts at hand, and what to report."""

    data: Measurements
    body: Body
    live: np.ndarray
    iterates: list[Array] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"build": 0.0, "solve": 0.0})
    restless: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))

    def converge(self, charts: Charts, e: float) -> tuple[Charts, float]:
        """Solve and anchor anew until the taxels stand still; `restless` are those that do not."""
        self.likelihood = self._likelihood(charts, e)
        self.iterates.append(charts.points)
        for _ in range(PASSES):
            tick = time.perf_counter()
            solution = self.likelihood.solve(charts, e)
            self.seconds["solve"] += time.perf_counter() - tick
            self.iterates.extend(charts.at(y) for y in solution.path[1:])
            moved, e = solution.coordinates, solution.log_modulus
            charts = chart.about(self.body, charts.at(moved), trilaterate.frames_of(charts))
            self.restless = np.abs(moved).max(axis=1) >= STILL
            if self.likelihood.covers(charts, e):
                if not self.restless.any():
                    break
            else:
                self.likelihood = self._likelihood(charts, e)
        return charts, e

    def _likelihood(self, charts: Charts, e: float) -> Likelihood:
        tick = time.perf_counter()
        made = Likelihood(self.data, self.live, charts.points, e, MODULUS_PRIOR)
        self.seconds["build"] += time.perf_counter() - tick
        return made


def _restart(run: _Run, charts: Charts, e: float) -> tuple[Charts, float, np.ndarray]:
    """Start misfitting taxels again from the centroid of their contacts; keep what fits better.

    Returns charts and e at rest, and the rows of the taxels that were moved.
    """
    before = run.likelihood.normal(charts, e).chi2
    limit = max(MISFIT if run.data.noise else MISFIT_NOMINAL, MISFIT * float(np.nanmedian(before)))
    bad = np.flatnonzero((before > limit) | run.restless)
    if not len(bad):
        return charts, e, bad
    points = charts.points.copy()
    points[bad] = trilaterate.centroids(run.data, run.body)[run.live[bad]]
    restless = run.restless
    other, e_other = run.converge(chart.about(run.body, points), e)
    settled = restless & ~run.restless
    after = run.likelihood.normal(other, e_other).chi2
    better = bad[(after[bad] < before[bad]) | settled[bad]]
    points = charts.points.copy()
    points[better] = other.points[better]
    charts, e = run.converge(
        chart.about(run.body, points, trilaterate.frames_of(charts)), e_other if len(better) else e
    )
    return charts, e, better


def _spread(values: Array, live: np.ndarray, data: Measurements, missing: object) -> Array:
    """`values` of the live taxels among all n taxels, the others filled with `missing`."""
    out = np.empty((len(data.ids), *values.shape[1:]))
    out[:] = missing
    out[live] = values
    return out
