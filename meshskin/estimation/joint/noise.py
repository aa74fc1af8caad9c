"""The noise of the readings, estimated from the residuals of neighbouring contacts, and the fit.

Errors of the model differ little between neighbouring contacts, so that half the mean square of the
differences of a taxel's residuals there is the variance of the noise. Readings that noise may have
lifted over the threshold are not used: those below it are not recorded, and the others would make
the noise look too small. Which readings these are is decided by what the model predicts, not by
what was read, so that the rest is not selected. The fitted unknowns follow the readings: a
difference of two residuals has the variance 2 - d C d', d being the difference of the derivatives
and C the covariance of the unknowns. Sources: von Neumann, Ann. Math. Stat. 12 (1941); Gasser,
Sroka, Jennen-Steinmetz, Biometrika 73 (1986).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ..data.measurements import NOMINAL_NOISE, Measurements
from ..data.pairs import SILENT_SIGMAS, silent_pairs
from ..data.patch_shape import MAX_EDGES
from ..uncertainty.goodness_of_fit import MIN_PAIRS, GoodnessOfFit, goodness_of_fit
from .fault_detection import MIN_SCALE, even, outliers
from .joint_estimator import JointEstimator
from .pressure import CENSORED, OBSERVED
from .readings import Readings
from .variable_projection import SchurComplement

MIN_CLEARANCE = 3.0
"""Distance of a predicted reading from threshold and saturation, in standard deviations, from which
its residual is as good as uncensored: 1e-3 of such readings are censored."""
MAX_STEPS = 2
"""Contacts from a reading to its neighbour in time, at most: one may be missing in between."""
MAX_APART = 3.0
"""Difference of the variances by neighbours in space and in time, in its standard deviation were
they independent, up to which it is chance: 1.3e-3 of equal ones differ by more on one side."""
MAX_SILENT = 10.0
"""Silent readings that inform, relative to the others, above which the believed reach is wrong:
where it is right they are fewer than the others."""
MAX_ITERATIONS = 10
"""Largest number of estimates: which readings are clear of the threshold depends on the noise."""
TOLERANCE = 0.01
"""Relative change of the noise at which it has converged."""
EDGE_NEAR = 2.0
"""Distance, in contact radii, within which contacts over an edge tell of its errors: those whose
patches overlap."""
EDGE_SIGMAS = 2.0
"""Excess of the residuals over edges, in its standard deviations, up to which it is chance."""
MAX_PART = 0.1
"""Part of the expected variance over all edges of a recording up to which single ones may have
less: thin layers have 0.2 and more (patch_shape.EDGE_ERROR)."""
MAX_CHANCE = 0.5
"""That excess, relative to what the heights let expect, from which the residuals are too few to
tell."""
MIN_TOLD = 0.5
"""Part of the contacts over edges whose residuals must tell for the others to have no larger part
of the expected variance than any of these."""


@dataclass(frozen=True)
class Noise:
    """An estimate of the noise."""

    scale: float
    """Standard deviation, in units of `Measurements.sigma`."""
    pairs: int
    """Independent pairs of readings that it was estimated from."""


def least_scale(data: Measurements) -> float:
    """The least noise that is believed, in units of `data.sigma`: below it, errors of the contact
    model decide."""
    return MIN_SCALE * NOMINAL_NOISE * data.nominal_peak / data.sigma


def predictions(readings: Readings, residuals: Array, data: Measurements) -> Array:
    """What the model predicts (k,), in units of the noise, from the residuals (k,)."""
    level = np.where(readings.kind == CENSORED, data.threshold, readings.level)
    return np.asarray(residuals / np.sqrt(readings.precision) + level / data.sigma)


def clear_of_limits(mu: Array, data: Measurements, scale: float | Array = 1.0) -> np.ndarray:
    """Predictions mu (k,) bool that noise of `scale` moves over no limit of the sensor."""
    margin = MIN_CLEARANCE * scale
    clear = mu > data.threshold / data.sigma + margin
    return np.asarray(clear & (mu < data.saturation / data.sigma - margin))


def certain_silences(readings: Readings, mu: Array, data: Measurements, scale: Array) -> np.ndarray:
    """Silent readings (k,) bool whose predictions mu (k,) are so far below the threshold that noise
    of `scale` (k,) would not lift them over it: they do not inform (SILENT_SIGMAS)."""
    clear = data.threshold / data.sigma - SILENT_SIGMAS * scale
    return np.asarray((readings.kind == CENSORED) & (mu < clear))


def with_estimated_noise(data: Measurements, estimator: JointEstimator) -> Measurements:
    """The data with the noise that a converged estimate of them shows; the same where it is known,
    where there are too few pairs of readings, where no noise is above the model's errors, and
    where most taxels that should respond are silent: then patch or disc are not the believed ones.
    """
    if data.noise is not None:
        return data
    noise = estimate_noise(estimator, estimator.problem.reduce(estimator.state))
    if noise.pairs < MIN_PAIRS or noise.scale <= least_scale(data):
        return data
    noisy = replace(data, noise=noise.scale * data.sigma, noise_pairs=noise.pairs)
    parametrization = estimator.problem.parametrization
    normals = parametrization.rotations()[:, :, 2]
    silent = silent_pairs(noisy, estimator.live, parametrization.points(), normals, 1.0)[0]
    return data if len(silent) > MAX_SILENT * len(data.pressure) else noisy


def with_estimated_edges(estimator: JointEstimator) -> Measurements:
    """The data with the errors over edges that a converged estimate of them shows, no larger than
    the heights there let expect; the same where the noise is not known, and where the residuals of
    all edges show such errors.

    Heights of the surface bound these errors; how large they are depends on the layer, and on
    whether the edge is one of the body or of its mesh alone. The mean square of the residuals of
    the contacts near each, beyond the noise, is their variance, where it is not chance. Where the
    residuals are too few to tell, it is the largest part of the expected one at the others.
    """
    data = estimator.data
    if data.noise is None or not data.edges:
        return data
    readings, r = estimator.likelihood.readings, estimator.residuals()
    clear = clear_of_limits(predictions(readings, r, data), data)
    clear &= (readings.kind == OBSERVED) & ~outliers(readings) & ~estimator.broken[readings.taxel]
    rows = np.flatnonzero(clear & (data.unevenness[readings.contact] > 0))
    reduced = estimator.problem.reduce(estimator.state)
    leverage = estimator.problem.leverages(estimator.state, reduced)[rows]
    contact, over = readings.contact[rows], np.flatnonzero(data.unevenness)
    alike, variance = data.alike[contact], data.edge_variance[contact]
    each = np.stack(
        [
            r[rows] ** 2 / readings.precision[rows],
            1.0 - leverage,
            alike * (1.0 - leverage),
            variance * np.maximum(1.0 - alike * leverage, 0.0),
        ]
    )
    sums = np.stack([np.bincount(contact, one, len(data.points))[over] for one in each], axis=1)
    square, noise, _, expected = sums.sum(axis=0)
    if square - noise > MAX_PART * expected:
        return data
    tree = cKDTree(data.points[over])
    near = tree.query_ball_point(data.points[over], EDGE_NEAR * data.radii[over])
    square, noise, chance, expected = np.array([sums[k].sum(axis=0) for k in near]).T
    excess, expected = square - noise, np.maximum(expected, 1e-300)
    scale = np.maximum(square / np.maximum(noise, 1e-300), 1.0)
    least = EDGE_SIGMAS * np.sqrt(2.0 * chance) * scale
    part = edge_parts(excess, least, expected)
    unevenness = data.unevenness.copy()
    unevenness[over] *= np.sqrt(part)
    return replace(data, unevenness=unevenness)


def edge_parts(excess: Array, least: Array, expected: Array) -> Array:
    """Parts (k,) of the `expected` variances (k,) at k contacts over edges that errors of the model
    have, by the `excess` (k,) of the residuals there over the noise; up to `least` (k,) it is
    chance."""
    part = np.minimum(np.where(excess > least, excess + least, 0.0) / expected, 1.0)
    told = least <= MAX_CHANCE * expected
    part[~told] = max(MAX_PART, part[told].max()) if np.mean(told) > MIN_TOLD else 1.0
    return part


def estimate_noise(estimator: JointEstimator, reduced: SchurComplement) -> Noise:
    """The noise of a converged estimate; no smaller than `least_scale`.

    With fewer than MIN_PAIRS pairs clear of the threshold, all readings count.
    """
    data, readings, r = estimator.data, estimator.likelihood.readings, estimator.residuals()
    mu, least = predictions(readings, r, data), least_scale(data)
    variances = partial(estimator.problem.difference_variances, estimator.state, reduced)

    def scatter(used: np.ndarray) -> Noise:
        return neighbour_scatter(readings, data.points, r, np.flatnonzero(used), variances)

    sound = (readings.kind == OBSERVED) & ~outliers(readings) & even(readings)
    noise = scatter(sound)
    for _ in range(MAX_ITERATIONS):
        found = scatter(sound & clear_of_limits(mu, data, max(noise.scale, least)))
        if found.pairs < MIN_PAIRS:
            break
        change, noise = abs(found.scale - noise.scale), found
        if change < TOLERANCE * noise.scale:
            break
    return Noise(max(noise.scale, least), noise.pairs)


def neighbour_scatter(
    readings: Readings,
    points: Array,
    r: Array,
    rows: np.ndarray,
    variances: Callable[[np.ndarray, np.ndarray], Array],
) -> Noise:
    """The noise by the differences of the residuals r (k,) of the readings `rows` of a taxel in
    neighbouring contacts; of neighbours in space and in time the smaller scatter counts, and both
    where their difference is chance: the smaller of two equal ones is too small on average.

    points (m, 3), m: of the contacts; variances: those (p,) of the differences of two rows (p,) of
    residuals, by unit noise.
    """
    found = []
    for a, b in neighbours(readings, points, rows):
        if len(a):
            found.append((np.sum((r[a] - r[b]) ** 2), variances(a, b).sum(), len(a)))
    square, expected, pairs = np.array(found, dtype=float).reshape(-1, 3).T
    enough = np.flatnonzero(2 * pairs >= pairs.max(initial=0.0))
    if not len(enough):
        return Noise(1.0, 0)
    ratio = square / expected
    least = enough[np.argmin(ratio[enough])]
    chance = MAX_APART * np.sqrt(2 / pairs + 2 / pairs[least]) * ratio[least]
    alike = enough[ratio[enough] - ratio[least] <= chance[enough]]
    together = square[alike].sum() / expected[alike].sum()
    return Noise(float(np.sqrt(together)), int(pairs[alike].max()))


def neighbours(
    readings: Readings, points: Array, rows: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Disjoint pairs, first and second (p,), of the readings `rows` of a taxel: mutual nearest
    neighbours in space, and next to each other in time. points (m, 3), m: of the contacts.
    """
    if len(rows) < 2:
        return []
    rows = rows[np.lexsort((readings.contact[rows], readings.taxel[rows]))]
    taxel, contact = readings.taxel[rows], readings.contact[rows]
    apart = 10 * float(np.ptp(points, axis=0).max()) + 1.0
    where = np.column_stack([points[contact], apart * taxel])
    nearest, own = cKDTree(where).query(where, k=2)[1], np.arange(len(rows))
    other = np.where(nearest[:, 0] == own, nearest[:, 1], nearest[:, 0])
    mutual = (other[other] == own) & (own < other) & (taxel == taxel[other])
    in_time = (np.diff(taxel) == 0) & (np.diff(contact) <= MAX_STEPS) & (own[:-1] % 2 == 0)
    return [(rows[mutual], rows[other[mutual]]), (rows[:-1][in_time], rows[1:][in_time])]


def residual_variance(readings: Readings, r: Array, kept: Array) -> float:
    """Variance of the residuals r (k,), each of which has the part kept (k,) of it, of observed
    readings that tell of the noise; where few do, that of all, and at least the nominal one."""
    observed = readings.kind == OBSERVED
    counted = observed & even(readings)
    few = kept[counted].sum() < (1 - MAX_EDGES) * kept[observed].sum()
    counted = observed if few else counted
    square = float(readings.weight[counted] @ r[counted] ** 2)
    return max(square / max(float(kept[counted].sum()), 1.0), 1.0 if few else 0.0)


def scale_and_fit(
    estimator: JointEstimator, reduced: SchurComplement
) -> tuple[float, GoodnessOfFit]:
    """The factor of the covariances, and the test of fit.

    The factor is 1 where the noise is known, else the variance of the residuals; or what the test
    shows where it fails. Each residual has the variance 1 less the leverage of its reading. The
    test uses readings that the model predicts well inside the sensor's range; that choice does not
    depend on the reading, so that the residuals are not censored.
    """
    data, problem, state = estimator.data, estimator.problem, estimator.state
    readings, r = estimator.likelihood.readings, estimator.residuals()
    kept = readings.weight - problem.leverages(state, reduced)
    known = data.noise is not None and not data.noise_pairs
    noise = Noise(1.0, 0) if known else estimate_noise(estimator, reduced)
    clear = clear_of_limits(predictions(readings, r, data), data, noise.scale)
    clear &= even(readings) & ~estimator.broken[readings.taxel]
    square, freedom = float(readings.weight[clear] @ r[clear] ** 2), float(np.sum(kept[clear]))
    fit = goodness_of_fit(
        chi2=square / noise.scale**2,
        freedom=freedom,
        noise_known=known,
        outlying=int(np.sum(outliers(readings))),
        pairs=noise.pairs,
    )
    fit = replace(fit, noise=noise.scale * data.sigma)
    scale = 1.0 if known else noise.scale**2
    if data.noise is None:
        scale = residual_variance(readings, r, kept)
    elif not known and freedom > 0:
        scale = square / freedom
    if fit.good is False:
        scale = max(scale, fit.reduced * noise.scale**2)
    return scale, fit
