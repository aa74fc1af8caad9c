"""The start of an estimate with a learned response on a large skin: what a part of it shows.

The global parameters and the variances are the same all over the skin, and a few hundred taxels
determine them nearly as well as all. Most steps of Gauss and Newton bring them to their values: a
part takes these steps in a fraction of the time, and all taxels only the last ones.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from scipy.spatial import cKDTree

from ..data.global_parameters import DRIFTS, OWN_DEPARTURES
from ..data.measurements import Measurements
from ..joint.readings import Readings
from ..posegraph.symmetric_blocks import SingularMatrixError
from .random_effects import RandomEffects

PARTS, SIZE = 4, 150
"""Regions of the skin, and taxels of each: neighbours, so that they share contacts, whose errors
show in what their taxels have in common."""
LEAST = 4
"""Taxels of the skin, relative to those of the part, from which a part is estimated first: it saves
five of eight steps of all taxels, and takes seven of its own (studies/speed/joint.py --sizes 4000
--learned)."""


def with_first_response(effects: RandomEffects) -> RandomEffects:
    """The estimate with the global parameters and variances that a part of the taxels has; as it is
    where taxels are few, contacts move, readings drift, or the part is singular or does not
    converge."""
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
