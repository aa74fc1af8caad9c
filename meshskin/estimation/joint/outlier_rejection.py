"""Outlier rejection: outlying readings are weighted down, left out, and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import MAD, Array
from ...core.errors import CalibrationError
from ..data.measurements import Measurements
from ..result import join_words
from ..trilateration import trilaterate
from . import fault_detection as faults
from .joint_estimator import JointEstimator
from .likelihood import Likelihood
from .parametrization import SurfaceParametrization
from .pressure import CENSORED, OBSERVED
from .readings import Readings

MAX_REMAINING = 0.5
"""Fraction of the misfitting taxels that may still misfit with gains and offsets, for these to be
the cause."""
MAX_MISFITTING_CONTACTS = 0.05
"""Largest fraction of misfitting contacts with which these, not the model, are taken as the cause.
"""
MAX_DISPLACED = 0.2
"""Fraction of the contacts that may be displaced far more than the others for these to be
outlying: twice what confuses the start of the estimate."""
LEAST_DISPLACED = 0.02
"""Least displacement, in contact radii, of an outlying contact: smaller ones harm no estimate."""
LEAST_FORCE = 0.5
"""Least error of ln F of an outlying contact: a force that is 1.6 times another is not scatter."""
RAYLEIGH = 1.1774
"""Median length of a vector of two standard normal variables; that of one is MAD."""
MAX_PRIOR_SIGMAS = 3.0
"""Gain or offset, in standard deviations of the prior, from which a taxel is faulty."""


def reject_outliers(estimator: JointEstimator) -> JointEstimator:
    """The estimator without outlying readings, where taxels misfit, and with their faults named.

    A taxel misfits if it is further off than most readings, or than most taxels: a misfit that all
    of them share is the model's. Those that only differ from the others in gain and offset are
    sound. Outliers are judged by the known noise first; where that leaves no fit, or would make
    more readings outlying than is plausible, the model is wrong, too, and they are judged by the
    scale of most residuals.
    """
    typical, suspects = _misfits(estimator)
    if not len(suspects):
        return estimator
    estimator = try_gain_offset(estimator, suspects)
    typical, suspects = _misfits(estimator)
    known = estimator.data.noise is not None
    if known and typical <= faults.MAX_SCALE:
        typical = 1.0  # most readings fit: the known noise decides what is outlying
    beyond = np.abs(_standardized(estimator, typical)) > faults.CUTOFF
    likelihood = _mean_log_likelihood(estimator, typical, beyond)
    for scale in (1.0, typical) if known and typical > 1.0 else (typical,):
        if not len(suspects):
            break
        trial = estimator.trial()
        try:
            remaining = irls(trial, suspects, scale, known)
        except CalibrationError:  # without an estimate no reading can be called outlying
            continue
        if remaining > faults.MAX_SCALE * scale:
            continue
        out = faults.outliers(trial.likelihood.readings)
        if scale >= typical or _mean_log_likelihood(trial, scale, out) > likelihood:
            _name_faults(trial, scale)
            return trial
    return estimator


def without_misfitting_contacts(estimator: JointEstimator, scale: float) -> Measurements:
    """The estimator's data without the contacts that misfit with noise of `scale`, in units of the
    data's; the data themselves where there are none, where they are too many to be exceptions, and
    where contacts were left out before.

    At a bump, or where the curvature jumps, a patch is another than the surface under its contact
    point says: all readings of the contact are wrong, those of a taxel in other contacts are not.
    """
    data = estimator.data
    readings = estimator.likelihood.readings
    bad = faults.misfitting_contacts(readings, estimator.residuals(), scale)
    most = MAX_MISFITTING_CONTACTS * len(np.unique(readings.contact))
    if len(data.misfitting) or not 0 < len(bad) <= most:
        return data
    return data.without_contacts(bad)


def displaced_contacts(errors: Array, touched: np.ndarray, radii: Array) -> np.ndarray:
    """Rows of the contacts whose points are displaced, or whose forces err, far more than most;
    none where they are too many to be exceptions.

    errors: (c, 3), displacements in the tangent planes, m, and errors of ln F, of contacts with
    `radii` (c,) m. Only those that are `touched` (c,) bool count.

    A tracker that loses its target, or a second contact, puts single points anywhere. One variance
    of all errors would take the weight of the others.
    """
    if not touched.any():
        return np.empty(0, dtype=int)
    size, force = np.linalg.norm(errors[:, :2], axis=1), np.abs(errors[:, 2])
    limits = (
        max(faults.CUTOFF * float(np.median(x[touched])) / middle, least)
        for x, middle, least in (
            (size, RAYLEIGH, LEAST_DISPLACED * float(np.median(radii))),
            (force, MAD, LEAST_FORCE),
        )
    )
    bad = np.flatnonzero(touched & ((size > next(limits)) | (force > next(limits))))
    return bad if len(bad) <= MAX_DISPLACED * touched.sum() else bad[:0]


def minority(contacts: np.ndarray, readings: Readings) -> np.ndarray:
    """Those of the rows `contacts` that are a minority of the contacts of each taxel: without a
    majority noise would place the taxel, and an error of all contacts of a place is systematic."""
    read = readings.kind == OBSERVED
    chosen = read & np.isin(readings.contact, contacts)
    n = len(readings.starts) - 1
    count, lost = (np.bincount(readings.taxel[k], minlength=n) for k in (read, chosen))
    most = lost > faults.MAX_TAXEL_OUTLIERS * count
    return np.setdiff1d(contacts, readings.contact[chosen & most[readings.taxel]])


def try_gain_offset(estimator: JointEstimator, suspects: np.ndarray) -> JointEstimator:
    """The estimator with a gain and an offset of each taxel, if these explain most of the
    `suspects` and only noise is left.

    Readings of a taxel that are all too large or too small by one factor are not faults. Where more
    than noise is left, gains would absorb errors of the model. The taxels are optimized first, the
    global parameters only if that succeeds.
    """
    parameters = estimator.data.parameters.with_nuisance(estimator.data.nominal_peak)
    if parameters.nuisance_names == estimator.data.parameters.nuisance_names:
        return estimator
    trial = estimator.trial()
    trial.data = replace(estimator.data, parameters=parameters)
    trial.likelihood = Likelihood(trial.data, estimator.likelihood.readings)
    trial.relinearize(estimator.problem.parametrization, estimator.state.s)
    trial.problem.solve_inner(trial.state)
    implausible, remaining = np.flatnonzero(_implausible(trial)), _misfits(trial)[1]
    unexplained = np.union1d(remaining, np.intersect1d(implausible, suspects))
    if len(unexplained) > MAX_REMAINING * len(suspects):
        return estimator
    # with an offset other readings count
    parametrization = trial.problem.parametrization
    trial.relinearize(parametrization, trial.state.s, trial.state.z, select_anew=True)
    try:
        trial.converge()
    except CalibrationError:
        return estimator
    if not _only_noise(trial):
        return estimator
    gains, responding = trial.problem.nuisance(trial.state.z)[:, 0], _responding(trial)
    for k in np.flatnonzero(_implausible(trial)):
        words = (
            f"gain of {np.exp(gains[k]):.2g}" if responding[k] else "silent in all that press it"
        )
        trial.faults[trial.live[k]] = words
    return trial


def _only_noise(estimator: JointEstimator) -> bool:
    """Whether residuals are as large as the known noise, or as from one contact to the next."""
    readings, residuals = estimator.likelihood.readings, estimator.residuals()
    noise = 1.0
    if estimator.data.noise is None:
        noise = faults.successive_difference_scale(readings, residuals)
    return faults.reading_scale(readings, residuals) <= faults.MAX_SCALE * noise


def _implausible(estimator: JointEstimator) -> np.ndarray:
    """Taxels (n,) bool that never respond, or whose gain or offset is far from its prior."""
    limit = MAX_PRIOR_SIGMAS * np.array(estimator.likelihood.nuisance_sigma)
    far = (np.abs(estimator.problem.nuisance(estimator.state.z)) > limit).any(axis=1)
    return np.asarray(far | ~_responding(estimator))


def _responding(estimator: JointEstimator) -> np.ndarray:
    """Taxels (n,) bool that have a reading."""
    readings = estimator.likelihood.readings
    read = readings.taxel[readings.kind != CENSORED]
    return np.bincount(read, minlength=len(estimator.live)) > 0


def _misfits(estimator: JointEstimator) -> tuple[float, np.ndarray]:
    """Scale of most residuals, or of the residuals of most taxels; the taxels that exceed it."""
    readings, residuals = estimator.likelihood.readings, _residuals(estimator)
    least = faults.MIN_SCALE if estimator.data.noise is None else 1.0
    for scale_of in (faults.reading_scale, faults.taxel_scale):
        typical = max(scale_of(readings, residuals), least)
        suspects = faults.misfitting_taxels(readings, residuals, typical)
        if len(suspects):
            break
    return typical, suspects


def _residuals(estimator: JointEstimator) -> Array:
    """Residuals (k,) in units of the noise; those of silent readings beyond the edge of all."""
    readings = estimator.likelihood.readings
    return faults.beyond_edge(readings, estimator.residuals(), estimator.data.sigma)


def _standardized(estimator: JointEstimator, scale: float) -> Array:
    """Residuals (k,) in their standard deviations with noise of `scale`."""
    return _residuals(estimator) / faults.spread(estimator.likelihood.readings, scale)


def _mean_log_likelihood(estimator: JointEstimator, scale: float, out: np.ndarray) -> float:
    """The likelihood with the readings `out` (k,) uniform over the range of the pressures."""
    width = float(estimator.data.pressure.max() / estimator.data.sigma)
    readings = estimator.likelihood.readings
    return faults.mean_log_likelihood(readings, estimator.residuals(), scale, out, width)


def irls(estimator: JointEstimator, suspects: np.ndarray, scale: float, fixed: bool) -> float:
    """Iteratively reweighted least squares of the readings of `suspects`, until no weight changes.

    scale: of the noise, constant if `fixed`. Returns the scale of the remaining residuals; inf
    where too many readings are left out, or where the others still do not fit.
    """
    if isinstance(estimator.problem.parametrization, SurfaceParametrization):
        points = estimator.problem.parametrization.points().copy()
        points[suspects] = trilaterate.medians(estimator.data, estimator.live[suspects])
        estimator.start_at(points)
    for stage in (*faults.GNC_STAGES, *[0.0] * faults.MAX_REWEIGHTINGS):
        r, readings = _residuals(estimator), estimator.likelihood.readings
        if not fixed:
            scale = max(faults.reading_scale(readings, r), faults.MIN_SCALE)
        if not stage:
            if fixed and faults.reading_scale(readings, r) > faults.MAX_SCALE * scale:
                return np.inf  # the readings that are not outlying do not fit either
            suspects = np.union1d(suspects, faults.misfitting_taxels(readings, r, scale))
        suspected = np.isin(readings.taxel, suspects)
        own = (readings.kind == OBSERVED) & suspected
        r = _standardized(estimator, scale)
        cutoff = faults.CUTOFF if stage else faults.equal_odds_cutoff(r[own])
        weight = faults.robust_weights(r, stage, cutoff)
        estimator.silent_weight[:] = 1.0
        if stage:  # observed readings place a taxel; silent ones are judged by that place
            weight[readings.kind == CENSORED] = estimator.silent_weight[suspects] = 0.0
        weight[~suspected] = 1.0
        if np.abs(weight - readings.weight).max() < faults.WEIGHT_TOLERANCE:
            break
        estimator.reweight(weight)
        estimator.converge()
    readings = estimator.likelihood.readings
    unanswered = faults.unanswered_presses(readings)
    if unanswered.any():
        estimator.silent_weight[np.unique(readings.taxel[unanswered])] = 0.0
        estimator.reweight(np.where(unanswered, 0.0, readings.weight))
        estimator.converge()
    readings = estimator.likelihood.readings
    if faults.outlier_fraction(readings) >= faults.MAX_OUTLIER_FRACTION:
        return np.inf
    return faults.reading_scale(readings, estimator.residuals())


def _name_faults(estimator: JointEstimator, scale: float) -> None:
    """Name the faults of each taxel; one that is mostly outlying is `broken`.

    A residual below CUTOFF standard deviations with noise of `scale` may be chance and alone is no
    fault.
    """
    readings, n = estimator.likelihood.readings, len(estimator.live)
    out, silent = faults.outliers(readings), readings.kind == CENSORED

    def count(which: np.ndarray) -> np.ndarray:
        return np.bincount(readings.taxel[which], minlength=n)

    far = out & (np.abs(_standardized(estimator, scale)) > faults.CUTOFF)
    read, outlying, unanswered = count(~silent), count(out & ~silent), count(far & silent)
    faulty = np.flatnonzero(count(far))
    points = estimator.problem.points(estimator.state)
    swapped = faults.swapped_taxels(estimator.data, readings, points, faulty)
    for k in map(int, faulty):
        row = estimator.live[k]
        words = [estimator.faults[row]]
        if k in swapped:
            words.append(f"swapped with {estimator.data.ids[estimator.live[swapped[k]]]}")
        if outlying[k]:
            words.append(f"{outlying[k]} of {read[k]} readings outlying")
        if unanswered[k]:
            words.append(f"silent in {unanswered[k]} contacts that press it")
        estimator.faults[row] = join_words(*words)
    if isinstance(estimator.problem.parametrization, SurfaceParametrization):
        # a module determines its taxels, whatever they read
        estimator.broken = outlying > faults.MAX_TAXEL_OUTLIERS * read
        estimator.broken |= unanswered > np.maximum(read, 1)
