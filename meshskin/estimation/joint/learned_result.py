"""The result of an estimate with a learned response: taxels, the response itself, and what the data
left undetermined.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...contact.learned import ProfileCorrection
from ...core.arrays import Array
from ..data.global_parameters import MOTION
from ..posegraph.symmetric_blocks import SingularMatrixError
from ..result import (
    CENSORING,
    MOSTLY_OUTLIERS,
    RIVAL,
    SURFACE,
    EstimatorResult,
    LearnedResponse,
)
from ..uncertainty.goodness_of_fit import GoodnessOfFit, goodness_of_fit
from . import fault_detection
from .creep import TIME
from .deviations import FLOOR
from .electronics import WIDTH
from .joint_estimator import JointEstimator
from .leaks import leak_covariances
from .noise import neighbours
from .null_space import undetermined_motion
from .pressure import CENSORED, OBSERVED, disc_means
from .random_effects import RandomEffects
from .rival_optima import RivalOptima

LEARNED_RESPONSE = "learned response: profile, exponents and compression estimated with the taxels"
FALLING = "the recorded readings fall with pressure: they were turned"
NOT_SEPARABLE = 0.9
"""Standard deviation, relative to that of its prior, from which a parameter rests on its prior."""
SAMPLES = 60
"""Distances at which the profile is stated, and levels of the response."""
MAX_CORRELATION, LARGEST_CORRELATION = 0.4, 0.95
"""Correlation of the displacements of neighbouring contacts above which they are no scatter:
independent ones have -0.1 to 0.15, by the taxels that they share; and the largest one that tells
how many contacts they stand for."""
FORCE_BINS = 16
"""Bins of the correlogram of force errors, up to two reaches of a contact."""
FORCE_CORRELATION = 0.05, 5.0
"""Least correlation of the force errors within half a reach that is no chance, and in standard
errors of independent ones; the taxels that contacts share make it -0.04 to -0.1 where the forces
scatter. A skin whose stiffness varies by 8 % over 2 mm has 0.19 to 0.24 with 3,000 contacts."""
CENTRES = 2000
"""Contacts, about, whose neighbours are compared: more change the correlogram little."""
MIN_CONTACTS = 20
"""Contacts, at least, whose displacements are compared."""


def learned_result(
    effects: RandomEffects,
    estimator: JointEstimator,
    rivals: RivalOptima,
    reasons: np.ndarray,
    clock: float,
) -> EstimatorResult:
    """The result for all taxels.

    Raises SingularMatrixError where the readings leave the covariance undetermined.
    """
    data, u, live = effects.data, effects.unknowns, estimator.live

    def spread(values: Array, missing: object) -> Array:
        out = np.empty((len(data.ids), *values.shape[1:]))
        out[:] = missing
        out[live] = values
        return out

    covariance, shared = effects.system().covariances()
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    if (variances <= 0).any() or (
        np.diag(shared) <= 0
    ).any():  # rounding, of a system near singular
        raise SingularMatrixError(int(np.argmin(variances.min(axis=1))))
    fit = _fit(effects)
    response = learned_response(effects, shared)
    scale = max(fit.reduced, 1.0) if fit.good is False else 1.0
    scale *= _fewer_contacts(response.contact_correlation) * response.alike_contacts
    points, rotations = u.parametrization.points(), u.parametrization.rotations()
    apart = np.nan_to_num(rivals.points - points)
    apart = np.einsum("kij,ki->kj", rotations[:, :, :2], apart)
    tangential = scale * covariance[:, :2, :2] + apart[:, :, None] * apart[:, None, :]
    tangential += _leaks(effects)
    lost, reasons = estimator.broken, reasons.copy()
    reasons[live], reasons[live[lost]] = "", MOSTLY_OUTLIERS
    infinite = np.diag([np.inf, np.inf])
    deviation = np.sqrt(scale * variances)
    unit = data.sigma * data.unit
    units = {name: 1.0 if name == "gain" else unit for name in data.parameters.nuisance_names}
    r = effects.residuals() ** 2 * (effects.readings.kind == OBSERVED)
    count = np.bincount(effects.readings.taxel, effects.readings.kind == OBSERVED, len(live))
    square = np.bincount(effects.readings.taxel, r, len(live))
    faults = estimator.faults.copy()
    for k in np.flatnonzero(np.isfinite(rivals.points[:, 0])):
        words = RIVAL.format(1e3 * float(np.linalg.norm(apart[k])))
        faults[live[k]] = ", ".join(filter(None, (faults[live[k]], words)))
    return EstimatorResult(
        points=spread(np.where(lost[:, None], np.nan, points), np.nan),
        rotations=spread(rotations, np.nan),
        covariance=spread(np.where(lost[:, None, None], infinite, tangential), infinite),
        chi2=spread(square / np.maximum(count - 2, 1), np.nan),
        reasons=reasons,
        factors=(
            LEARNED_RESPONSE,
            *((FALLING,) if data.falling else ()),
            *response.describe(),
            *((CENSORING,) if (effects.readings.kind == CENSORED).any() else ()),
            SURFACE,
        ),
        unknowns=_shared_values(effects, scale * shared),
        undetermined=_not_separable(effects, shared),
        taxel_unknowns={
            name: np.stack(
                [
                    spread(u.nuisance[:, k] * unit, np.nan),
                    spread(deviation[:, 2 + k] * unit, np.inf),
                ],
                axis=1,
            )
            for k, (name, unit) in enumerate(units.items())
        },
        faults=faults,
        rivals=spread(rivals.points, np.nan),
        fit=fit,
        response=response,
        contact_errors=u.errors,
        iterates=np.stack([spread(p, np.nan) for p in effects.iterates]),
        seconds={"joint": time.perf_counter() - clock},
    )


def _fit(effects: RandomEffects) -> GoodnessOfFit:
    """The test of fit: residuals against the known noise, or against the scatter of neighbouring
    contacts, whose residuals have the same leverages."""
    readings, r = effects.readings, effects.residuals()
    clear = effects.clear()
    known, noise, pairs = effects.noise_known, 1.0, 0
    if not known:
        noise, pairs = _neighbour_scatter(effects, r, np.flatnonzero(clear))
    fit = goodness_of_fit(
        chi2=float(readings.weight[clear] @ r[clear] ** 2) / noise**2,
        freedom=float(readings.weight[clear] @ (1 - effects.leverages[clear] * known)),
        noise_known=known,
        outlying=int(np.sum(fault_detection.outliers(readings))),
        pairs=pairs,
    )
    return replace(fit, noise=noise * effects.deviations.noise * effects.data.sigma)


def _neighbour_scatter(effects: RandomEffects, r: Array, rows: np.ndarray) -> tuple[float, int]:
    """Standard deviation of the residuals r (k,) by the differences of the readings `rows` of a
    taxel in neighbouring contacts, and the number of pairs; of neighbours in space and in time the
    smaller counts."""
    found = [
        (float(np.sqrt(np.mean((r[a] - r[b]) ** 2) / 2)), len(a))
        for a, b in neighbours(effects.readings, effects.data.points, rows)
        if len(a)
    ]
    enough = [pair for pair in found if 2 * pair[1] >= max(n for _, n in found)]
    return min(enough) if enough else (1.0, 0)


def _shared_values(effects: RandomEffects, covariance: Array) -> dict[str, tuple[float, float]]:
    """Global parameters but for the profile, and the deviations of the contacts' errors."""
    parameters, d = effects.data.parameters, effects.deviations
    m = max(int(effects.probes.touched.sum()), 1)
    found = parameters.named(effects.unknowns.s, covariance)
    for label in parameters.labels[parameters.columns["profile"]]:
        del found[label]
    found["contact_scatter"] = d.position, d.position / float(np.sqrt(4 * m))
    found["force_scatter"] = d.force, d.force / float(np.sqrt(2 * m))
    return found


def _not_separable(effects: RandomEffects, covariance: Array) -> tuple[str, ...]:
    """Shared parameters that rest on their priors, in words."""
    parameters = effects.data.parameters
    sigma = np.sqrt(np.diag(covariance))
    weak = tuple(
        f"{label} is not determined"
        for k, label in enumerate(parameters.labels)
        if not label.startswith(("profile", MOTION))
        and sigma[k] > NOT_SEPARABLE * parameters.sigma[k]
    )
    return (*weak, *undetermined_motion(parameters, covariance))


def learned_response(effects: RandomEffects, covariance: Array) -> LearnedResponse:
    """The learned profile beside the model's, and the learned response; covariance (ks, ks): of the
    global parameters."""
    data, s = effects.data, effects.unknowns.s
    columns, middle = data.parameters.columns, int(np.argsort(data.force)[len(data.force) // 2])
    contacts = effects.linearized.at(s)
    rows = np.full(SAMPLES, middle)
    radius = float(contacts.patches.first[middle])
    u = np.linspace(0.0, data.profile_extent, SAMPLES)
    offset = (u * radius)[:, None] * contacts.directions[rows]
    model = disc_means(data.model.name, offset, rows, contacts, data.disc)[0]
    basis, correction, _ = ProfileCorrection(data.profile_extent)(u, s[columns["profile"]])
    peak = float(contacts.peaks[middle]) * data.unit
    at = columns["profile"]
    band = np.sqrt(np.einsum("ki,ij,kj->k", basis, covariance[at, at], basis))
    level = np.linspace(0.0, peak, SAMPLES)
    c = columns["compression"].start
    nominal = data.nominal_peak * data.unit
    force_correlation, alike = _alike_forces(effects)
    return LearnedResponse(
        distance=u * radius,
        profile=peak * (model + correction),
        profile_sigma=peak * band,
        model=peak * model,
        level=level,
        reading=level / (1 + s[c] * level / nominal),
        reading_sigma=level**2 / nominal * float(np.sqrt(covariance[c, c])),
        contact_scatter=effects.deviations.position,
        contact_correlation=_neighbour_correlation(effects),
        force_scatter=effects.deviations.force,
        force_correlation=force_correlation,
        alike_contacts=alike,
        noise=effects.deviations.noise * data.sigma * data.unit,
        noise_relative=effects.deviations.relative,
        coefficients=s[at],
        extent=data.profile_extent,
        levels=data.response_levels,
        unit=data.unit,
        hysteresis=_hysteresis(effects),
        crosstalk=data.parameters.value("crosstalk", s),
        leaking=1.0 if data.leaks is None else float(data.leaks.weight.mean()),
        drift=_drift(effects),
        creep=_creep(effects),
        gain_drift=float(np.expm1(_common_drift(effects, "gain_drift"))),
        offset_drift=_common_drift(effects, "offset_drift") * nominal,
        contact=data.model.name,
        references=(
            data.belief.force_reference or 1.0,
            data.typical_curvature,
            data.nominal_peak,
            data.modulus,
        ),
    )


def _hysteresis(effects: RandomEffects) -> tuple[float, float]:
    """Share of the play operator, and its half-width relative to the nominal peak."""
    columns = effects.data.parameters.columns
    if "hysteresis" not in columns:
        return 0.0, 0.0
    share, log_width = effects.unknowns.s[columns["hysteresis"]]
    return float(share), WIDTH * float(np.exp(log_width))


def _leaks(effects: RandomEffects) -> Array:
    """What to add to the tangential covariances (n, 2, 2), m^2, for neighbours that may
    crosstalk or not."""
    if effects.data.leaks is None:
        return np.zeros((2, 2))
    share = effects.data.parameters.value("crosstalk", effects.unknowns.s)
    return leak_covariances(effects.fitted(), share)


def _creep(effects: RandomEffects) -> tuple[float, float]:
    """Share of creep, and its time constant, s."""
    columns = effects.data.parameters.columns
    if "creep" not in columns:
        return 0.0, 0.0
    share, log_time, _ = effects.unknowns.s[columns["creep"]]
    return float(share), TIME * float(np.exp(log_time))


def _common_drift(effects: RandomEffects, name: str) -> float:
    """Largest change during the recording of the drift `name` of all taxels."""
    columns = effects.data.parameters.columns
    if name not in columns:
        return 0.0
    return float(np.ptp(effects.data.drifts @ effects.unknowns.s[columns[name]]))


def _drift(effects: RandomEffects) -> float:
    """Standard deviation of the offsets' drift, in the unit of the readings."""
    if "drift" not in effects.data.parameters.nuisance_names:
        return 0.0
    return effects.deviations.drift * effects.data.sigma * effects.data.unit


def _fewer_contacts(correlation: float) -> float:
    """Factor of the variances where displacements of neighbouring contacts correlate, for they are
    taken as independent: that of a mean in a first-order autoregressive sequence."""
    if correlation <= MAX_CORRELATION:
        return 1.0
    return (1 + correlation) / (1 - min(correlation, LARGEST_CORRELATION))


def _neighbour_correlation(effects: RandomEffects) -> float:
    """Correlation of the displacements of contacts with those of their nearest neighbours.

    Errors of a kinematic model or of the clocks change slowly over the body or the path; scatter
    does not.
    """
    from scipy.spatial import cKDTree

    contacts, errors = effects.linearized.at(effects.unknowns.s), effects.unknowns.errors
    used = np.flatnonzero(effects.probes.touched)
    if len(used) < MIN_CONTACTS or effects.deviations.position <= FLOOR["position"]:
        return 0.0
    across = np.cross(contacts.normals, contacts.directions)
    moved = errors[:, :1] * contacts.directions + errors[:, 1:2] * across
    points, moved = effects.data.points[used], moved[used]
    nearest = cKDTree(points).query(points, k=2)[1][:, 1]
    power = float(np.sum(moved**2))
    return float(np.sum(moved * moved[nearest])) / power if power > 0 else 0.0


def _alike_forces(effects: RandomEffects) -> tuple[float, float]:
    """Correlation of the errors of ln force of neighbouring contacts, and how many contacts one
    stands for by it; (0, 1) where chance explains it.

    Errors of a sensor differ from contact to contact. Those that contacts at one place share are
    the skin's: a foam whose thickness or stiffness varies. They displace the taxels there, however
    many contacts there are: of independent errors with variance v the mean of n has v / n, of these
    v / n times the sum of the correlogram over all contacts. What the readings of a contact tell of
    its error displaces nothing: only the rest of the variance counts.
    """
    from scipy.spatial import cKDTree

    used, data = np.flatnonzero(effects.probes.touched), effects.data
    if len(used) < MIN_CONTACTS or effects.deviations.force <= FLOOR["force"]:
        return 0.0, 1.0
    points, error = data.points[used], effects.unknowns.errors[used, 2]
    open_share = 1.0 - min(float(np.mean(error**2)) / effects.deviations.force**2, 1.0)
    error = (error - error.mean()) / max(float(error.std()), 1e-300)
    tree, far = cKDTree(points), 2.0 * float(np.median(data.reach()[used]))
    centres = np.arange(len(used))[:: max(len(used) // CENTRES, 1)]
    found = tree.query_ball_point(points[centres], far)
    first = np.repeat(centres, [len(near) for near in found])
    second = np.concatenate([np.asarray(near, dtype=int) for near in found])
    first, second = first[first != second], second[first != second]
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    ring = np.minimum((FORCE_BINS * distance / far).astype(int), FORCE_BINS - 1)
    count = np.bincount(ring, minlength=FORCE_BINS)
    total = np.bincount(ring, error[first] * error[second], FORCE_BINS)
    pairs = max(int(count[: FORCE_BINS // 4].sum()), 1)
    correlation = float(total[: FORCE_BINS // 4].sum()) / pairs
    least, errors = FORCE_CORRELATION
    if correlation < max(least, errors / np.sqrt(pairs * len(used) / len(centres) / 2)):
        return 0.0, 1.0
    end = np.flatnonzero((total <= 0) & (count > 0))
    alike = float(total[: end[0] if len(end) else None].sum()) / len(centres)
    return correlation, 1.0 + open_share * alike
