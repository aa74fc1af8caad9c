"""Recordings that cannot calibrate a skin, whatever their size: the failure as a result.

A robot that reports skin contacts (skinContactList of YARP) computes each contact point from the
taxels that answer and its own map of them. A calibration by these points would only return that
map. What such a recording does show is which taxels answer, and how often.
"""

from __future__ import annotations

import numpy as np

from ..recording.recording import Recording
from ..scene.belief import Belief
from .calibration import Calibration, provenance_of
from .uncertainty.verdict import FAIL, Verdict

OFF = 5e-3
"""Median distance of contact points from the body, m, above which they are not on its skin: the
skins of robots are thinner."""
CIRCULAR = "contact points that were computed from the map that is sought"
"""Reason of every taxel."""
UNTOUCHED = "no answer while the skin had a single contact"
"""Reason of a taxel without readings."""


def uncalibrated(recording: Recording, belief: Belief) -> Calibration:
    """The calibration of no taxel, with the readings of each and a verdict of FAIL."""
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
        anchor="none: the contact points are the robot's own map",
        factors=(),
        chi2=np.full(n, np.nan),
        reasons=np.where(touched, CIRCULAR, UNTOUCHED).astype(object),
        verdict=Verdict(FAIL, _reasons(recording, readings, belief)),
        provenance=provenance_of("none", recording),
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
