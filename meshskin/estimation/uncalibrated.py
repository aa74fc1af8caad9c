"""Recordings that do not calibrate a skin: the failure as a result.

Some cannot, whatever their size. A robot that reports skin contacts (skinContactList of YARP)
computes each contact point from the taxels that answer and its own map of them. A calibration by
these points would only return that map. What such a recording does show is which taxels answer, and
how often.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.errors import CalibrationError
from ..recording.recording import Recording
from ..scene.belief import Belief
from .calibration import Calibration, provenance_of
from .uncertainty.verdict import FAIL, Verdict

OFF = 5e-3
"""Median distance of contact points from the body, m, above which they are not on its skin: the
skins of robots are thinner."""
CIRCULAR = "contact points that were computed from the map that is sought"
"""Reason of every taxel."""
UNCONVERGED = "the estimate did not converge"
"""Reason of every taxel of such an estimate."""
UNTOUCHED = "no answer while the skin had a single contact"
"""Reason of a taxel without readings."""


def uncalibrated(recording: Recording, belief: Belief) -> Calibration:
    """The calibration by contact points that the robot computed from its own taxels."""
    found = of_no_taxel(
        recording, belief, CIRCULAR, "none: the contact points are the robot's own map"
    )
    return replace(found, verdict=Verdict(FAIL, _reasons(recording, found.readings, belief)))


def of_no_taxel(recording: Recording, belief: Belief, reason: str, anchor: str) -> Calibration:
    """The calibration of no taxel for a reason, with the readings of each."""
    ids = np.asarray(belief.taxel_ids)
    ids = ids if len(ids) else np.unique(recording.reading_taxel)
    answered = recording.pressure > 0
    order = np.argsort(ids)
    row = order[np.minimum(np.searchsorted(ids[order], recording.reading_taxel), len(ids) - 1)]
    known = answered & (ids[row] == recording.reading_taxel)
    readings, n = np.bincount(row[known], minlength=len(ids)), len(ids)
    touched = readings > 0
    return Calibration(
        ids=ids,
        poses=np.full((n, 4, 4), np.nan),
        covariances=np.tile(np.diag([np.inf] * 6), (n, 1, 1)),
        observed=np.zeros((n, 6), dtype=bool),
        touched=touched,
        readings=readings,
        method="none",
        anchor=anchor,
        factors=(),
        chi2=np.full(n, np.nan),
        reasons=np.where(touched, reason, UNTOUCHED).astype(object),
        provenance=provenance_of("none", recording),
    )


def unconverged(recording: Recording, belief: Belief, error: CalibrationError) -> Calibration:
    """The calibration by an estimate that did not converge: no taxel, and the unknowns of a contact
    motion as they were before the readings."""
    motion, unknowns = belief.contact_motion, {}
    if motion is not None:
        sigma = np.linalg.norm(motion.root, axis=1)
        known = zip(motion.labels, motion.mean, sigma, strict=True)
        unknowns = {label: (float(value), float(s)) for label, value, s in known}
    return replace(
        of_no_taxel(recording, belief, UNCONVERGED, "none: no estimate"),
        belief=belief,
        frame=belief.body.frame,
        unknowns=unknowns,
        verdict=Verdict(FAIL, (f"no taxel is determined: {error}",)),
    )


def _reasons(recording: Recording, readings: np.ndarray, belief: Belief) -> tuple[str, ...]:
    """What cannot be calibrated, what to record instead, and what the recording shows."""
    touched = readings[readings > 0]
    distance = np.abs(belief.body.closest(recording.points).distance)
    typical = float(np.median(distance)) if len(distance) else 0.0
    off = (
        f"the contact points lie {1e3 * typical:.2g} mm off the surface of the body in the median, "
        f"limit {1e3 * OFF:g} mm: the robot's map, the mesh or its pose in the link is wrong; "
        "check them before the skin is touched again"
    )
    span = f"{touched.min()} to {touched.max()}" if len(touched) else "no"
    return (
        "places and orientations cannot be calibrated: the contact points were computed by the "
        "robot from the taxels that answered and its own map of them, so that a calibration would "
        "return that map; touch the skin with an indenter whose place is known (joint angles and "
        "--indenter-mm, or a stream of poses of the contact)",
        "gains and the response cannot be calibrated: the taxels of a contact all have its mean "
        "reading; record the raw port of the skin, too",
        f"what the recording shows: {len(touched)} of {len(readings)} taxels answer, in {span} of "
        f"the {len(recording.time)} frames with a single contact",
        *([off] if typical > OFF else ()),
    )
