"""The estimate doubted: outlying readings weighed down, taken out and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.errors import CalibrationError
from ..trilateration import trilaterate
from . import fault_detection
from .joint_estimator import JointEstimator
from .likelihood import Likelihood
from .parametrization import SurfaceParametrization
from .pressure import CENSORED, OBSERVED

ACQUITTED = 0.5
"""Most of the suspects, relative, that may be left where taxels differ in gain and offset."""
ODD = 3.0
"""Gain or offset, in standard deviations before any data, from which a taxel is not sound."""


def reject_outliers(run: JointEstimator) -> JointEstimator:
    """The run without outlying readings, where taxels cannot be right, and with what they show.

    Taxels are suspected that are further off than most readings, or than most taxels: a misfit that
    all of them share is the model's, and says nothing against any of them. Those that only differ
    from the others in gain and offset are acquitted. What is outlying is judged by the known noise
    first; where that does not leave a fit, or would take more for outlying than is plausible, the
    model is off, too, and it is judged by how far off most are.
    """
    typical, suspects = _suspects(run)
    if not len(suspects):
        return run
    run = try_gain_offset(run, suspects)
    typical, suspects = _suspects(run)
    known = bool(run.data.noise)
    if known and typical <= fault_detection.MAX_SCALE:
        typical = 1.0  # most readings fit: what is outlying is so by the noise
    believed = _plausibility(
        run, typical, np.abs(run.residuals()) > fault_detection.CUTOFF * typical
    )
    for scale in (1.0, typical) if known and typical > 1.0 else (typical,):
        if not len(suspects):
            break
        trial = run.trial()
        try:
            left = _irls(trial, suspects, scale, known)
        except CalibrationError:  # without a fit nothing can be called outlying
            left = np.inf
        fits = left <= fault_detection.MAX_SCALE * scale
        if fits and scale < typical:
            out = fault_detection.outliers(trial.likelihood.readings)
            fits = _plausibility(trial, scale, out) > believed
        if fits:
            _name(trial, scale)
            return trial
    return run


def try_gain_offset(run: JointEstimator, suspects: np.ndarray) -> JointEstimator:
    """The run with a gain and an offset of each taxel, if these acquit most of the suspects, and
    only noise is left.

    A taxel whose readings are all too large or too small alike is none that is broken. Where more
    than noise is left, gains would stand in for what is wrong with the model. First only the taxels
    settle; what they all share follows where that is worth it.
    """
    shared = run.data.shared.unlike(float(np.median(run.data.peaks)))
    if shared.local_names == run.data.shared.local_names:
        return run
    trial = run.trial()
    trial.data = replace(run.data, shared=shared)
    trial.likelihood = Likelihood(trial.data, run.likelihood.readings, shared)
    trial.relinearize(run.problem.parametrization, run.state.s)
    trial.problem.solve_inner(trial.state)
    odd, left = np.flatnonzero(_odd(trial)), _suspects(trial)[1]
    if len(np.union1d(left, np.intersect1d(odd, suspects))) > ACQUITTED * len(suspects):
        return run
    places = trial.problem.parametrization  # with an offset other readings count
    trial.relinearize(places, trial.state.s, trial.state.z, select_anew=True)
    try:
        trial.converge()
    except CalibrationError:
        return run
    if not _noise_is_left(trial):
        return run
    gains = trial.problem.extras(trial.state.z, np.arange(trial.problem.parametrization.count))[
        :, 0
    ]
    for k in np.flatnonzero(_odd(trial)):
        words = (
            f"gain of {np.exp(gains[k]):.2g}" if _heard(trial)[k] else "silent in all that press it"
        )
        trial.faults[trial.live[k]] = words
    return trial


def _noise_is_left(run: JointEstimator) -> bool:
    """Whether residuals are the noise, if it is known, or as large from one contact to the next."""
    readings, residuals = run.likelihood.readings, run.residuals()
    noise = (
        1.0 if run.data.noise else fault_detection.successive_difference_scale(readings, residuals)
    )
    return fault_detection.reading_scale(readings, residuals) <= fault_detection.MAX_SCALE * noise


def _odd(run: JointEstimator) -> np.ndarray:
    """Taxels (n,) that are never heard, or whose gain or offset is too far from the prior to be a
    sound one's.
    """
    extras = run.problem.extras(run.state.z, np.arange(run.problem.parametrization.count))
    far = (np.abs(extras) > ODD * np.array(run.likelihood.local_sigma)).any(axis=1)
    return np.asarray(far | ~_heard(run))


def _heard(run: JointEstimator) -> np.ndarray:
    """Taxels (n,) that have a reading."""
    readings = run.likelihood.readings
    return np.bincount(readings.taxel[readings.kind != CENSORED], minlength=len(run.live)) > 0


def _suspects(run: JointEstimator) -> tuple[float, np.ndarray]:
    """How far off most readings are, or most taxels, and the taxels that are further off."""
    readings, residuals = run.likelihood.readings, run.residuals()
    least = 1.0 if run.data.noise else fault_detection.MIN_SCALE
    for scale_of in (fault_detection.reading_scale, fault_detection.taxel_scale):
        typical = max(scale_of(readings, residuals), least)
        suspects = fault_detection.misfitting_taxels(readings, residuals, typical)
        if len(suspects):
            break
    return typical, suspects


def _plausibility(run: JointEstimator, scale: float, out: np.ndarray) -> float:
    width = float(run.data.pressure.max() / run.data.sigma)
    return fault_detection.mean_log_likelihood(
        run.likelihood.readings, run.residuals(), scale, out, width
    )


def _irls(run: JointEstimator, suspects: np.ndarray, scale: float, fixed: bool) -> float:
    """Weigh the readings of suspects until no weight changes; the scale of what is left.

    Infinite where too much is left out, or where it does not help. The scale of the noise is
    `scale`, if `fixed`.
    """
    places = run.problem.parametrization
    if isinstance(places, SurfaceParametrization):  # from where most of their readings are
        points = places.points().copy()
        points[suspects] = trilaterate.medians(run.data, run.body, run.live[suspects])
        z = run.state.z.copy()
        z[:, : places.size] = 0.0
        run.relinearize(places.about(run.body, points), run.state.s, z)
    for stage in (*fault_detection.GNC_STAGES, *[0.0] * fault_detection.MAX_REWEIGHTINGS):
        r, readings = run.residuals(), run.likelihood.readings
        if not fixed:
            scale = max(fault_detection.reading_scale(readings, r), fault_detection.MIN_SCALE)
        if not stage:
            if (
                fixed
                and fault_detection.reading_scale(readings, r) > fault_detection.MAX_SCALE * scale
            ):
                return np.inf  # without what the suspects read the others do not fit either
            suspects = np.union1d(suspects, fault_detection.misfitting_taxels(readings, r, scale))
        own = (readings.kind == OBSERVED) & np.isin(readings.taxel, suspects)
        cut = fault_detection.CUTOFF if stage else fault_detection.equal_odds_cutoff(r[own], scale)
        weight = fault_detection.robust_weights(r, scale, stage, cut)
        run.silent_weight[:] = 1.0
        if stage:  # what was heard says where a taxel is; then what was not is judged by it
            weight[readings.kind == CENSORED] = run.silent_weight[suspects] = 0.0
        weight[~np.isin(readings.taxel, suspects)] = 1.0
        if np.abs(weight - readings.weight).max() < fault_detection.WEIGHT_TOLERANCE:
            break
        run.reweight(weight)
        run.converge()
    mute = fault_detection.unanswered_presses(run.likelihood.readings)
    if mute.any():
        run.silent_weight[np.unique(run.likelihood.readings.taxel[mute])] = 0.0
        run.reweight(np.where(mute, 0.0, run.likelihood.readings.weight))
        run.converge()
    readings = run.likelihood.readings
    lost = fault_detection.outlier_fraction(readings)
    return (
        fault_detection.reading_scale(readings, run.residuals())
        if lost < fault_detection.MAX_OUTLIER_FRACTION
        else np.inf
    )


def _name(run: JointEstimator, scale: float) -> None:
    """Say of each taxel what is wrong; one that is mostly outlying is `broken`.

    What is less than CUT times the noise's `scale` off may be chance: it alone accuses no taxel.
    """
    readings, n = run.likelihood.readings, len(run.live)
    out, silent = fault_detection.outliers(readings), readings.kind == CENSORED

    def count(which: np.ndarray) -> np.ndarray:
        return np.bincount(readings.taxel[which], minlength=n)

    far = out & (np.abs(run.residuals()) > fault_detection.CUTOFF * scale)
    heard, wild, mute = count(~silent), count(out & ~silent), count(far & silent)
    guilty = np.flatnonzero(count(far))
    points = run.problem.points(run.state)
    pairs = fault_detection.swapped_taxels(run.data, readings, points, guilty)
    for k in guilty:
        words = [f"{wild[k]} of {heard[k]} readings outlying"] if wild[k] else []
        if mute[k]:
            words.append(f"silent in {mute[k]} contacts that press it")
        if int(k) in pairs:
            words.insert(0, f"swapped with {run.data.ids[run.live[pairs[int(k)]]]}")
        run.faults[run.live[k]] = ", ".join(filter(None, [run.faults[run.live[k]], *words]))
    if isinstance(
        run.problem.parametrization, SurfaceParametrization
    ):  # else its module places a taxel, whatever it reads
        run.broken = (wild > fault_detection.MAX_TAXEL_OUTLIERS * heard) | (
            mute > np.maximum(heard, 1)
        )
