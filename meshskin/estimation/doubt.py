"""The estimate doubted: outlying readings weighed down, taken out and named."""

from __future__ import annotations

import numpy as np

from ..errors import CalibrationError
from . import faults, trilaterate
from .factors.pressure import HEARD, SILENT
from .places import Free
from .run import Run


def doubt(run: Run) -> None:
    """Take out outlying readings, where taxels cannot be right, and name what they show.

    Taxels are suspected that are further off than most readings, or than most taxels: a misfit that
    all of them share is the model's, and says nothing against any of them. What is outlying is
    judged by the known noise first; where that does not leave a fit, or would take more for
    outlying than is plausible, the model is off, too, and it is judged by how far off most are.
    """
    readings, residuals = run.likelihood.readings, run.residuals()
    known = bool(run.data.noise)
    for scale_of in (faults.typical, faults.typical_taxel):
        typical = max(scale_of(readings, residuals), 1.0 if known else faults.LEAST)
        suspects = faults.suspects(readings, residuals, typical)
        if len(suspects):
            break
    else:
        return
    plain = run.problem, run.state, run.weight.copy(), run.restless
    believed = _plausibility(run, typical, np.abs(residuals) > faults.CUT * typical)
    for scale in (1.0, typical) if known and typical > 1.0 else (typical,):
        try:
            left = _sift(run, suspects, scale, known)
        except CalibrationError:  # without a fit nothing can be called outlying
            left = np.inf
        fits = left <= faults.TAKEN * scale
        if fits and scale < typical:
            fits = _plausibility(run, scale, faults.outlying(run.likelihood.readings)) > believed
        if fits:
            _name(run, scale)
            return
        run.problem, run.state, _, run.restless = plain
        run.weight, run.silent_weight[:] = plain[2].copy(), 1.0
        run.likelihood = run.problem.likelihood


def _plausibility(run: Run, scale: float, out: np.ndarray) -> float:
    width = float(run.data.pressure.max() / run.data.sigma)
    return faults.plausibility(run.likelihood.readings, run.residuals(), scale, out, width)


def _sift(run: Run, suspects: np.ndarray, scale: float, fixed: bool) -> float:
    """Weigh the readings of suspects until no weight changes; the scale of what is left.

    Infinite where too much is left out, or where it does not help. The scale of the noise is
    `scale`, if `fixed`.
    """
    places = run.problem.places
    if isinstance(places, Free):  # from where most of their readings are
        points = places.points().copy()
        points[suspects] = trilaterate.medians(run.data, run.body, run.live[suspects])
        z = run.state.z.copy()
        z[:, : places.size] = 0.0
        run.anchor(places.about(run.body, points), run.state.s, z)
    for stage in (*faults.STAGES, *[0.0] * faults.CUTS):
        r, readings = run.residuals(), run.likelihood.readings
        if not fixed:
            scale = max(faults.typical(readings, r), faults.LEAST)
        if not stage:
            if fixed and faults.typical(readings, r) > faults.TAKEN * scale:
                return np.inf  # without what the suspects read the others do not fit either
            suspects = np.union1d(suspects, faults.suspects(readings, r, scale))
        own = (readings.kind == HEARD) & np.isin(readings.taxel, suspects)
        cut = faults.CUT if stage else faults.even_odds(r[own], scale)
        weight = faults.weights(r, scale, stage, cut)
        run.silent_weight[:] = 1.0
        if stage:  # what was heard says where a taxel is; then what was not is judged by it
            weight[readings.kind == SILENT] = run.silent_weight[suspects] = 0.0
        weight[~np.isin(readings.taxel, suspects)] = 1.0
        if np.abs(weight - readings.weight).max() < faults.STILL:
            break
        run.weigh(weight)
        run.converge()
    mute = faults.mute(run.likelihood.readings)
    if mute.any():
        run.silent_weight[np.unique(run.likelihood.readings.taxel[mute])] = 0.0
        run.weigh(np.where(mute, 0.0, run.likelihood.readings.weight))
        run.converge()
    readings = run.likelihood.readings
    lost = faults.lost(readings)
    return faults.typical(readings, run.residuals()) if lost < faults.MOST else np.inf


def _name(run: Run, scale: float) -> None:
    """Say of each taxel what is wrong; one that is mostly outlying is `broken`.

    What is less than CUT times the noise's `scale` off may be chance: it alone accuses no taxel.
    """
    readings, n = run.likelihood.readings, len(run.live)
    out, silent = faults.outlying(readings), readings.kind == SILENT

    def count(which: np.ndarray) -> np.ndarray:
        return np.bincount(readings.taxel[which], minlength=n)

    far = out & (np.abs(run.residuals()) > faults.CUT * scale)
    heard, wild, mute = count(~silent), count(out & ~silent), count(far & silent)
    guilty = np.flatnonzero(count(far))
    points = run.problem.points(run.state)
    pairs = faults.exchanged(run.data, readings, points, guilty)
    for k in guilty:
        words = [f"{wild[k]} of {heard[k]} readings outlying"] if wild[k] else []
        if mute[k]:
            words.append(f"silent in {mute[k]} contacts that press it")
        if int(k) in pairs:
            words.insert(0, f"swapped with {run.data.ids[run.live[pairs[int(k)]]]}")
        run.faults[run.live[k]] = ", ".join(words)
    if isinstance(run.problem.places, Free):  # else its module places a taxel, whatever it reads
        run.broken = (wild > faults.BROKEN * heard) | (mute > np.maximum(heard, 1))
