"""Whether the position of a taxel is the only one that its readings allow.

As the batch estimate (joint/rival_optima.py, joint/likelihood_widths.py), for few taxels at once
and in parts: a taxel whose contacts leave a wide sector of directions open is started again from
elsewhere, with the global parameters as they are.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..chart import Charts, tangential_square
from ..data.measurements import Measurements
from ..joint.joint_estimator import JointEstimator
from ..joint.likelihood_widths import widened_along_axis
from ..joint.parametrization import SurfaceParametrization
from ..joint.reduced_nlp import MAX_ITERATIONS
from ..joint.rival_optima import MAX_LOG_ODDS, likeliest_rivals

STEPS = 2
"""Gauss-Newton steps of one part of the work: 2 ms a taxel (studies/speed/online.py)."""


@dataclass(frozen=True)
class Basins:
    """What other positions the readings of t taxels allow."""

    better: Array
    """Positions (t, 3), m, that fit better than the estimate; NaN where there is none."""
    spread: Array
    """What the tangential covariance (t, 2, 2), m^2, lacks: the distance of a position that fits
    nearly as well, and the width of a likelihood that is wider than its curvature says."""
    unique: np.ndarray
    """Whether (t,) no other position fits nearly as well."""


def examine(
    data: Measurements,
    weight: Array,
    charts: Charts,
    nuisance: Array,
    s: Array,
    covariance: Array,
) -> Generator[None, None, Basins]:
    """Look for other positions of t taxels at converged estimates, the origins of `charts`.

    The work is done in parts, between which the generator yields; it returns what was found. data:
    of these taxels; weight (k,): of the readings; nuisance (t, q), s (ks,): the estimates;
    covariance (t, 2, 2), m^2: along the charts' tangents.
    """
    rows = np.arange(len(charts.points))
    step = float(np.median(data.radii)) / 2
    estimator = JointEstimator(
        data, rows, SurfaceParametrization(charts, step), weight,
        MAX_ITERATIONS, shared=s, nuisance=nuisance,
    )  # fmt: skip
    yield
    places, odds = yield from likeliest_rivals(estimator, rows, charts.points, STEPS)
    yield
    wide = yield from widened_along_axis(estimator, rows, covariance, 1.0)
    rival = odds < MAX_LOG_ODDS
    apart = np.where(rival[:, None], places - charts.points, 0.0)
    return Basins(
        better=np.where((odds < 0)[:, None], places, np.nan),
        spread=wide - covariance + tangential_square(charts.tangents, apart),
        unique=~rival,
    )
