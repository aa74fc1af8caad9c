"""Where an estimate with a learned response begins: at trilateration, at a former estimate, or at
what a part of a large skin shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ...core.progress import Stage
from .. import chart
from ..data.global_parameters import DRIFTS, MOTION, OWN_DEPARTURES
from ..data.measurements import Measurements
from ..joint import fault_detection
from ..joint.joint_estimator import JointEstimator
from ..joint.parametrization import SurfaceParametrization, Unknowns
from ..joint.readings import Readings, select
from ..posegraph.symmetric_blocks import SingularMatrixError
from ..result import EstimatorResult
from .deviations import UNMEASURED_FORCE, Deviations
from .estimated_response import response_levels
from .random_effects import RandomEffects

STEP = 1e-3
"""Longest move of a taxel in one step, m."""
PARTS, SIZE = 4, 150
"""Regions of the skin, and taxels of each: neighbours, so that they share contacts, whose errors
show in what their taxels have in common."""
LEAST = 4
"""Taxels of the skin, relative to those of the part, from which a part is estimated first: it saves
five of eight steps of all taxels, and takes seven of its own (studies/speed/joint.py --sizes 4000
--learned)."""


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


def with_first_response(effects: RandomEffects) -> RandomEffects:
    """The estimate with the global parameters and variances that a part of the taxels has; as it is
    where taxels are few, contacts move, readings drift, or the part is singular or does not
    converge.

    These are the same all over the skin, and a few hundred taxels determine them nearly as well as
    all. Most steps of Gauss and Newton bring them to their values: a part takes these steps in a
    fraction of the time, and all taxels only the last ones.
    """
    u, chosen, parameters = effects.unknowns, PARTS * SIZE, effects.data.parameters
    drifts = {*DRIFTS, *OWN_DEPARTURES} & {*parameters.names, *parameters.nuisance_names}
    if len(u.nuisance) < LEAST * chosen or parameters.move_contacts or drifts:
        return effects
    points = u.parametrization.points()
    middles = points[np.linspace(0, len(points) - 1, PARTS).astype(int)]
    part = _part(effects, np.unique(cKDTree(points).query(middles, k=SIZE)[1]))
    try:
        converged = part.converge()
    except SingularMatrixError:
        return effects
    if not converged:
        return effects
    effects.deviations = part.deviations
    effects.move(replace(u, s=part.unknowns.s))
    effects.spread = effects.deviations.noise_of(effects.mu, effects.uneven)
    effects.restraint = 0
    return effects


def _part(effects: RandomEffects, taxels: np.ndarray) -> RandomEffects:
    """The estimate of the `taxels` alone, in the contacts where they read or are silent."""
    u, readings = effects.unknowns, effects.readings
    rows, count = readings.of(taxels), np.diff(readings.starts)[taxels]
    contacts, contact = np.unique(readings.contact[rows], return_inverse=True)
    data, kept = _of_contacts(effects.data, contacts)
    source = readings.source[rows]
    each = {f.name: getattr(readings, f.name)[rows] for f in fields(readings)[:-2]}
    each |= {
        "contact": contact,
        "taxel": np.repeat(np.arange(len(taxels)), count),
        "source": np.where(source < 0, -1, np.searchsorted(kept, source)),
    }
    there = replace(u.parametrization, charts=u.parametrization.charts[taxels], side=None)
    unknowns = replace(
        u, parametrization=there, nuisance=u.nuisance[taxels], errors=u.errors[contacts]
    )
    starts, live = np.append(0, np.cumsum(count)), readings.live[taxels]
    part = Readings(**each, starts=starts, live=live)
    return RandomEffects(data, part, unknowns, effects.deviations, stage=effects.stage)


def _of_contacts(data: Measurements, rows: np.ndarray) -> tuple[Measurements, np.ndarray]:
    """The measurements in the contacts `rows`, rising, and which of the readings these have."""
    kept = np.flatnonzero(np.isin(data.contact, rows))
    names = ("points", "normals", "directions", "curvature", "force", "time", "recorded")
    part = replace(
        data.select(kept),
        **{name: getattr(data, name)[rows] for name in names},
        contact=np.searchsorted(rows, data.contact[kept]),
        patches=data.patches.take(rows),
        headings=None if data.headings is None else data.headings[rows],
        references=(data.typical_curvature, data.nominal_peak),
        corrupt=np.empty((0, 2), dtype=int),
        misfitting=np.empty(0, dtype=int),
        unread=np.empty(0, dtype=int),
    )
    part.__dict__["uneven"] = data.uneven[rows]
    return part, kept
