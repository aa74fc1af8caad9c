"""An earlier map tested by a few touches: what was moved, turned, exchanged, died or changed gain.

Every module (or every single taxel where there are no modules) is a unit. Its readings are
predicted from the earlier map with its uncertainty, and their likelihood is compared with that
under every change (evidence.py). The errors of readings and touches, E* and the scale of the
readings are estimated from the same touches, with the units in the states found so far, until these
no longer change. This starts from large errors without changes, and from ordinary errors with the
changes that these take; the more probable result counts.
"""

from __future__ import annotations

import numpy as np

from ...core.arguments import check_real, check_type
from ...core.blas import single_threaded
from ...core.errors import CalibrationError
from ...core.progress import Progress, Stage
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...skin.skin import Skin
from ..calibration import Calibration
from ..cross_validation import recorded_belief
from . import errors as error_model
from .errors import Errors
from .evidence import Change, Evidence, is_placed, judge
from .hypotheses import (
    CONFIRMED,
    DEAD,
    EXCHANGED,
    GAIN,
    NOT_TOUCHED,
    TURNED,
    UNDECIDED,
    Hypothesis,
    unchanged,
)
from .readings import read
from .result import Finding, Recalibration, updated
from .skin_map import SIGMA, SkinMap, skin_map
from .touches import Touches

FALSE_ALARM = 0.01
"""Default bound on the probability that anything is found where nothing changed."""
MAX_PASSES, USUAL_PASSES = 6, 3
"""Most passes over all units from each of two starts, each with the errors by the states of the
last, and what is usual where nothing has changed, with the pass that finds this."""


@single_threaded()
def recalibrate(
    previous: Calibration | Skin,
    recording: Recording,
    belief: Belief | None = None,
    *,
    false_alarm: float = FALSE_ALARM,
    sigma: float = SIGMA,
    progress: Progress | None = None,
) -> Recalibration:
    """Test an earlier map by the touches of a recording, and update it by what has changed.

    previous: the earlier map. belief: as in `calibrate`; by default that of `previous`, which a
    loaded calibration and a skin do not have; rigid modules are those of `module_slots`, or those
    of iCub where the ids are theirs. false_alarm: the probability, at most, of finding any change
    where there is none. sigma: standard deviation, m, of places along each tangent in a map that
    states none. progress("recalibrate", done, total): called after each unit of each pass, whose
    number is not known before. Raises CalibrationError without a belief, for taxels that the map
    does not have, for raw readings of a map without a learned response and for fewer than 8
    readings; RecordingError as `calibrate`.
    """
    check_type(Recording, recording, "what an earlier map is tested by")
    check_real("false_alarm", false_alarm, above=0.0, most=0.5, error=CalibrationError)
    if belief is None:
        if not isinstance(previous, Calibration) or previous.belief is None:
            raise CalibrationError(
                "a skin or a loaded calibration does not know the scene",
                remedy="give recalibrate a belief",
            )
        belief = recorded_belief(previous)
    known = skin_map(previous, belief, sigma)
    touches = read(recording, belief, known)
    limit = float(np.log(len(known.units) / false_alarm))
    stage = Stage(progress, "recalibrate", USUAL_PASSES * len(known.units))
    states = [unchanged(known, unit) for unit in range(len(known.units))]
    fits = [_settled(touches, limit, states, stage)]
    found = _judged(touches, limit, error_model.start(touches), stage)
    if any(evidence.changes for evidence in found):  # else the second fit is the first
        fits.append(_settled(touches, limit, [evidence.state for evidence in found], stage))
    stage.end()
    errors, found = max(fits, key=lambda fit: _score(fit[0], fit[1], touches, limit))
    findings = _findings(known, found)
    strongest = [e.changes[0].log_evidence if e.changes else e.log_evidence for e in found]
    units = enumerate(found)
    placed = [e.touched.any() and is_placed(touches, u, errors, e.state) for u, e in units]
    return Recalibration(
        calibration=updated(known, belief, found, findings, len(touches.data.points)),
        findings=findings,
        units=known.numbers,
        unit=known.noun,
        unit_states=_unit_states(found),
        unit_evidence=np.array(strongest) / np.log(10),
        placed=np.array(placed),
        ids=known.ids,
        states=_taxel_states(known, found),
        false_alarm=false_alarm,
        errors=errors,
        peak=touches.unit,
        contacts=len(touches.data.points),
    )


def _settled(
    touches: Touches, limit: float, states: list[Hypothesis], stage: Stage
) -> tuple[Errors, list[Evidence]]:
    """Errors and states that agree, from the errors that `states` of the units take."""
    errors, seen = error_model.start(touches), []
    for _ in range(MAX_PASSES):
        errors = error_model.fit(touches, states, errors)
        found = _judged(touches, limit, errors, stage)
        states = [evidence.state for evidence in found]
        signature = [(h.state, h.taxel, h.value) for h in states]
        if signature in seen:
            break
        seen.append(signature)
    return errors, found


def _judged(touches: Touches, limit: float, errors: Errors, stage: Stage) -> list[Evidence]:
    """What the readings say of each unit with these errors: one pass."""
    found = []
    for unit in range(len(touches.known.units)):
        found.append(judge(touches, unit, errors, limit))
        stage.step()
    return found


def _score(errors: Errors, found: list[Evidence], touches: Touches, limit: float) -> float:
    """ln of the probability of all readings, each change being as improbable as its evidence had to
    be large."""
    total = error_model.log_prior(errors, touches) + error_model.far_silence(errors, touches)
    for evidence in found:
        total += evidence.null + sum(-c.log_chance - limit for c in evidence.changes)
    return total


def _unit_states(found: list[Evidence]) -> np.ndarray:
    states = []
    for e in found:
        whole = [c.hypothesis.state for c in e.changes if c.hypothesis.taxel < 0]
        if whole:
            states.append(whole[0])
        elif not e.touched.any():
            states.append(NOT_TOUCHED)
        else:
            states.append(CONFIRMED if e.confirmed else UNDECIDED)
    return np.array(states, dtype=object)


def _taxel_states(known: SkinMap, found: list[Evidence]) -> np.ndarray:
    """State (n,) of each taxel: that of its unit's change, or of its own."""
    states = np.full(len(known.ids), NOT_TOUCHED, dtype=object)
    for rows, e in zip(known.units, found, strict=True):
        sound = CONFIRMED if e.confirmed else UNDECIDED
        states[rows[e.touched]] = UNDECIDED
        states[rows[e.alive]] = sound
        for change in e.changes:
            h = change.hypothesis
            states[rows if h.taxel < 0 else rows[h.taxel]] = h.state
    return states


def _findings(known: SkinMap, found: list[Evidence]) -> tuple[Finding, ...]:
    out = []
    for number, rows, e in zip(known.numbers, known.units, found, strict=True):
        for change in e.changes:
            h = change.hypothesis
            alone = h.taxel >= 0
            out.append(
                Finding(
                    "taxel" if alone else known.noun,
                    int(known.ids[rows[h.taxel]] if alone else number),
                    h.state,
                    _words(known, change) + _rival(known, rows, change),
                    change.log_evidence / np.log(10),
                    float(min(1.0, len(found) * np.exp(max(change.log_chance, -700.0)))),
                )
            )
    return tuple(sorted(out, key=lambda finding: -finding.evidence))


def _rival(known: SkinMap, rows: np.ndarray, change: Change) -> str:
    """Words on the change that the readings do not exclude in place of this one; "" without any."""
    h = change.rival
    if h is None:
        return ""
    what = f"taxel {known.ids[rows[h.taxel]]}" if h.taxel >= 0 else f"the {known.noun}"
    odds = np.exp(change.log_rival)
    verb = "has another gain" if h.state == GAIN else f"is {h.state}"
    return f"; or {what} {verb}, {odds:.2g} times as probable: touch it again"


def _words(known: SkinMap, change: Change) -> str:
    h = change.hypothesis
    if h.state == TURNED:
        return f"turned by {np.degrees(h.value):.0f} degrees about its normal"
    if h.state == EXCHANGED:
        return f"reads at the place of {known.noun} {h.value:.0f}"
    if h.state == DEAD:
        return "dead: silent where it was pressed"
    if h.state == GAIN:
        factor, spread = np.exp(change.log_gain), change.log_gain_sigma
        return f"gain times {factor:.2f} (+- {factor * spread:.2g})"
    size, spread = np.linalg.norm(change.shift), np.linalg.eigvalsh(change.shift_covariance)[-1]
    return f"moved by {1e3 * size:.2f} mm (+- {1e3 * np.sqrt(spread):.2g})"
