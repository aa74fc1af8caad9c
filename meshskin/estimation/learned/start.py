"""Where an estimate with a learned response begins: at trilateration, or at a former estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array
from ...core.progress import Stage
from .. import chart
from ..data.global_parameters import MOTION
from ..data.measurements import Measurements
from ..joint import fault_detection
from ..joint.joint_estimator import JointEstimator
from ..joint.parametrization import SurfaceParametrization, Unknowns
from ..joint.readings import select
from ..result import EstimatorResult
from .deviations import UNMEASURED_FORCE, Deviations
from .estimated_response import response_levels
from .random_effects import RandomEffects

STEP = 1e-3
"""Longest move of a taxel in one step, m."""


@dataclass(frozen=True, eq=False)
class Former:
    """An estimate from which that of the same taxels begins once contacts have moved a little."""

    effects: RandomEffects
    estimator: JointEstimator
    """The taxels under its response, without outlying readings."""
    departures: Mapping[str, float]
    """Scores of the departures that are not estimated."""
    ended: bool
    """Whether the search for departures came to an end."""
    excluded: tuple[str, ...]
    """Departures that came out implausible."""

    def serves(self, live: np.ndarray) -> bool:
        """Whether an estimate of the taxels `live` can begin from this one."""
        return np.array_equal(self.estimator.live, live)

    def same_contacts(self, data: Measurements) -> bool:
        """Whether these are the contacts of `data`, but for their places."""
        return np.array_equal(self.effects.data.time, data.time)

    def without_misfits(self, data: Measurements) -> Measurements:
        """The measurements without the contacts that were left out, if they are the same ones."""
        bad = self.effects.data.misfitting
        return data.without_contacts(bad) if len(bad) and self.same_contacts(data) else data

    def weight(self, data: Measurements) -> Array:
        """Weights (k,) of the readings: 0 of those that were outlying, if contacts are the same."""
        at, weight = self.effects.data, np.ones(len(data.pressure))
        if self.same_contacts(data):
            n = len(data.ids)
            out = (at.contact * n + at.taxel)[self.estimator.weight < 0.5]
            weight[np.isin(data.contact * n + data.taxel, out)] = 0.0
        return weight


def begin(
    data: Measurements, live: np.ndarray, start: EstimatorResult, stage: Stage
) -> RandomEffects:
    """The estimate at its start by trilateration."""
    s, nuisance = data.parameters.start(), np.zeros((len(live), 2))
    if start.modulus is not None and data.unit == 1.0:
        s[data.parameters.columns["modulus"]] = np.log(start.modulus / data.modulus)
    for column, (name, unit) in enumerate({"gain": 1.0, "offset": data.sigma}.items()):
        if name in start.taxel_unknowns:
            nuisance[:, column] = np.nan_to_num(start.taxel_unknowns[name][live, 0]) / unit
    places = _places(data, live, start.points[live], start.rotations[live])
    unknowns = Unknowns(places, nuisance, np.zeros((len(data.points), 3)), s)
    weight, points = np.ones(len(data.pressure)), places.charts.points
    readings = select(data, live, points, places.charts.normals, 0.0, weight, np.ones(len(live)))
    noise = 1.0 if data.belief.noise_sigma is not None else _first_noise(start, data)
    data = replace(data, response_levels=response_levels(data, readings, unknowns))
    deviations = Deviations(noise=noise)
    if not data.force_measured:
        deviations = replace(deviations, least_force=UNMEASURED_FORCE)
    return RandomEffects(data, readings, unknowns, deviations, stage=stage)


def resumed(data: Measurements, live: np.ndarray, former: Former, stage: Stage) -> RandomEffects:
    """The estimate at the values of a former one, with its departures and without its outlying
    readings; data: as of `with_learned_response`. Errors of contacts are zero where these are
    others."""
    at, u, estimator = former.effects.data, former.effects.unknowns, former.estimator
    data = replace(
        data,
        parameters=replace(at.parameters, motion=data.parameters.motion),
        belief=replace(data.belief, response_groups=at.belief.response_groups),
        leaks=at.leaks,
        profile_extent=at.profile_extent,
        response_levels=at.response_levels,
    )
    s, columns = u.s.copy(), data.parameters.columns
    if MOTION in columns:
        s[columns[MOTION]] = data.parameters.start()[columns[MOTION]]
    charts = u.parametrization.charts
    rotations = np.concatenate([charts.tangents, charts.normals[:, :, None]], axis=2)
    places = _places(data, live, charts.points, rotations)
    errors = u.errors if former.same_contacts(data) else np.zeros((len(data.points), 3))
    reach = estimator.selected_at[2] if former.effects.electronics is None else 0.0
    readings = select(
        data, live, places.charts.points, places.charts.normals, reach, former.weight(data),
        estimator.silent_weight,
    )  # fmt: skip
    unknowns = Unknowns(places, u.nuisance, errors, s)
    return RandomEffects(data, readings, unknowns, former.effects.deviations, stage=stage)


def _places(
    data: Measurements, live: np.ndarray, points: Array, rotations: Array
) -> SurfaceParametrization:
    """The taxels at `points` (n, 3), m, with frames near `rotations` (n, 3, 3)."""
    height = 0.0 if data.heights is None else data.heights[live]
    charts = chart.charts_at(data.body, points, rotations, height)
    return SurfaceParametrization.of(data, live, charts, STEP)


def _first_noise(start: EstimatorResult, data: Measurements) -> float:
    if start.fit is None or not np.isfinite(start.fit.noise):
        return 1.0
    return max(start.fit.noise / data.sigma, fault_detection.MIN_SCALE)
