"""The response that an estimate learned, in the terms of `LearnedResponse`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...contact.learned import ProfileCorrection
from ...core.arrays import Array
from ..data.measurements import Measurements
from ..joint.contacts import LinearizedContacts
from ..joint.electronics import TIME, WIDTH
from ..joint.likelihood import Likelihood
from ..joint.parametrization import Unknowns
from ..joint.pressure import disc_means
from ..joint.readings import Readings
from ..result import LearnedResponse
from .contact_correlations import AlikeErrors, force_scatter, neighbour_correlation
from .random_effects import RandomEffects

END = 0.02
"""Part of the recording, at both ends, whose drifts are not stated."""
SAMPLES = 60
"""Distances at which the profile is stated, and levels of the response."""
LEVEL_SAMPLE = 1000
"""Taxels and contacts whose mean level the compression refers to: more change it by below 1 %."""


def learned_response(
    effects: RandomEffects, covariance: Array, alike: AlikeErrors
) -> LearnedResponse:
    """The learned responses of all groups of taxels, the first one's with the others in it;
    covariance (ks, ks): of the global parameters; alike: errors that contacts share."""
    data, s = effects.data, effects.unknowns.s
    nominal = data.nominal_peak * data.unit
    first, *others = (_curves(effects, covariance, g) for g in range(data.parameters.groups))
    found = LearnedResponse(
        **first,
        contact_scatter=effects.deviations.position,
        contact_correlation=neighbour_correlation(effects),
        force_scatter=force_scatter(effects),
        alike_contacts=alike.factor,
        alike_parts=alike.parts,
        noise=effects.deviations.noise * data.sigma * data.unit,
        noise_relative=effects.deviations.relative,
        edge_error=effects.deviations.shape,
        extent=data.profile_extent,
        levels=data.response_levels,
        unit=data.unit,
        hysteresis=_share(effects, "hysteresis", WIDTH),
        crosstalk=data.parameters.value("crosstalk", s),
        leaking=1.0 if data.leaks is None else float(data.leaks.weight.mean()),
        drift=_own(effects, "drift") * data.sigma * data.unit,
        skew=_own(effects, "skew"),
        creep=_share(effects, "creep", TIME),
        gain_drift=float(np.expm1(_common_drift(effects, "gain_drift"))),
        offset_drift=_common_drift(effects, "offset_drift") * nominal,
        force_drift=float(np.expm1(_common_drift(effects, "force_drift"))),
        contact=data.model.name,
        references=(
            data.belief.force_reference or 1.0,
            data.typical_curvature,
            data.nominal_peak,
            data.modulus,
        ),
    )
    return replace(found, others=tuple(replace(found, **curves) for curves in others))


def _curves(effects: RandomEffects, covariance: Array, group: int) -> dict[str, Any]:
    """The learned profile of a group beside the model's, and its response to levels, by their names
    in LearnedResponse; covariance (ks, ks): of the global parameters."""
    data, s = effects.data, effects.unknowns.s
    columns = data.parameters.columns_of(group)
    middle = int(np.argsort(data.force)[len(data.force) // 2])
    contacts = effects.linearized.at(s).each[group]
    rows = np.full(SAMPLES, middle)
    radius = float(contacts.patches.first[middle])
    u = np.linspace(0.0, data.profile_extent, SAMPLES)
    offset = (u * radius)[:, None] * contacts.directions[rows]
    model = disc_means(data.model.name, offset, rows, contacts, data.disc)[0]
    basis, correction, _ = ProfileCorrection(data.profile_extent)(u, s[columns["profile"]])
    peak = float(contacts.peaks[middle]) * data.unit
    at, c = columns["profile"], columns["compression"].start
    band = np.sqrt(np.einsum("ki,ij,kj->k", basis, covariance[at, at], basis))
    level = np.linspace(0.0, peak * float(np.max(model + correction)), SAMPLES)  # that occur
    nominal, own = data.nominal_peak * data.unit, data.parameters.groups > 1
    reading = level / (1 + s[c] * level / nominal)
    return {
        "distance": u * radius,
        "profile": peak * (model + correction),
        "profile_sigma": peak * band,
        "model": peak * model,
        "level": level,
        "reading": reading,
        "reading_sigma": reading**2 / nominal * float(np.sqrt(covariance[c, c])),
        "coefficients": s[at],
        "taxels": np.sort(data.ids[data.groups == group])[: own * len(data.ids)],
    }


def _share(effects: RandomEffects, name: str, unit: float) -> tuple[float, float]:
    """Share of the departure `name`, and its width or time constant; zeros without it."""
    columns = effects.data.parameters.columns
    if name not in columns:
        return 0.0, 0.0
    share, log_scale, *_ = effects.unknowns.s[columns[name]]
    return float(share), unit * float(np.exp(log_scale))


def _common_drift(effects: RandomEffects, name: str) -> float:
    """Largest change of the drift `name` of all taxels within the recording but for its ends, where
    few contacts determine the polynomials."""
    columns = effects.data.parameters.columns
    if name not in columns:
        return 0.0
    inner = np.abs(effects.data.phase - 0.5) < 0.5 - END
    return float(np.ptp(effects.data.drifts[inner] @ effects.unknowns.s[columns[name]]))


def _own(effects: RandomEffects, name: str) -> float:
    """Deviation of a parameter that each taxel has, where it is estimated; else 0."""
    estimated = name in effects.data.parameters.nuisance_names
    return float(getattr(effects.deviations, name)) if estimated else 0.0


def response_levels(data: Measurements, readings: Readings, u: Unknowns) -> tuple[float, float]:
    """Levels of the readings, relative to the nominal peak, that determine gains and errors of
    ln F: means over taxels and contacts, LEVEL_SAMPLE of each if there are more, weighted by the
    information of each reading.

    A compression that made gains smaller at the same readings would be preferred for that alone:
    the estimate is the mode, in which a change of scale of its effects counts.
    """
    contacts = LinearizedContacts(data, u.s).with_errors(u.s, u.errors)
    points, found = u.parametrization.points(), []
    for row, owner in ((3, readings.taxel), (-1, readings.contact)):
        few = np.flatnonzero(owner % max(owner.max(initial=0) // LEVEL_SAMPLE, 1) == 0)
        contact, taxel = readings.contact[few], readings.taxel[few]
        mu, jacobian = Likelihood(data, readings).predict(
            contact, points[taxel], u.nuisance[taxel], contacts, data.groups[readings.live[taxel]]
        )
        weight, level = jacobian[row] ** 2, mu * data.sigma / data.nominal_peak
        total = np.bincount(owner[few], weight)
        mean = np.bincount(owner[few], weight * level) / np.maximum(total, 1e-300)
        found.append(float(np.mean(mean[total > 0])))
    return found[0], found[1]
