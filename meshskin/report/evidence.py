"""Sections that a report on a real recording has in place of errors: no truth is needed.

How well held-out contacts are localized, where residuals are large, and what the contacts say of
the robot's kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .data import ReportData
from .maps import LARGE
from .markup import SavedFigure, paragraphs, saved_figure, table
from .theme import compact, significant

HELD_OUT = "Held-out contacts"
"""Title of the section about a cross-validation."""
SHOWN = 8
"""Taxels with large residuals that are listed."""


def kinematics(data: ReportData) -> dict[str, list[str]]:
    """The section about contacts that follow from joint angles; none for others."""
    given = data.metrics.get("kinematics")
    if not isinstance(given, Mapping):
        return {}
    rows = []
    for name, values in given["joints"].items():
        offset = values["offset_rad"]
        stated = "not declared"
        if offset is not None:
            value, sigma = np.degrees(offset)
            stated = f"{value:.3f} ± {significant(float(sigma))}"
        error = significant(float(np.degrees(values["error_rad"])))
        rows.append((name, stated, error, f"{values['explained']:.0%}", f"{values['chance']:.2g}"))
    header = (
        "joint", "offset (deg)", "error that varies with the angle (deg rms)",
        "explains of the heights left", "by chance",
    )  # fmt: skip
    words = (
        f"Contacts lie {significant(given['height_before_mm'])} mm off the body before the "
        f"estimate, {significant(given['height_mm'])} mm after it. A joint whose error varies with "
        "its angle, by an eccentric encoder or a bent link, would explain a part of what is left "
        "that chance does not."
    )
    return {"Kinematics": [paragraphs(words), table(header, rows, numeric=(2, 3, 4))]}


def validation(data: ReportData) -> dict[str, list[str]]:
    """The section about contacts that were held out, if there was a cross-validation."""
    m = data.metrics.get("cross_validation")
    if m is None:
        return {}
    if not m["localized"]:
        return {HELD_OUT: [paragraphs("No held-out contact was read by three taxels.")]}
    rows = [
        (name, *(significant(m[key][s]) for s in ("rms", "p95")))
        for name, key in (
            ("maximum likelihood", "error_mm"),
            ("centroid of the taxels that read", "centroid_error_mm"),
        )
    ]
    words = (
        f"Contacts were held out in {m['folds']} folds, in blocks of consecutive ones, and "
        "localized from their readings alone by the skin calibrated on the others: "
        f"{m['localized']} of {m['contacts']} contacts, the others having been read by fewer than "
        "three taxels. The error is the distance from the recorded contact point, whose own error "
        "it contains.",
        f"Taxel pitch: {significant(m['taxel_pitch_mm'])} mm. Log likelihood of held-out readings: "
        f"{compact(m['log_likelihood_per_reading'], 4)} per reading, in the recorded unit; it "
        "compares calibrations of the same recording.",
    )
    header = ("contacts localized by", "rms error (mm)", "95th percentile (mm)")
    return {HELD_OUT: [table(header, rows, numeric=(1, 2)), paragraphs(*words)]}


def residuals(data: ReportData, pictures: Sequence[SavedFigure]) -> dict[str, list[str]]:
    """The section about the residuals over the body, where `pictures` has their map."""
    if not pictures:
        return {}
    r, ids = data.residuals, np.asarray(data.calibration.ids)
    large = np.flatnonzero(r > LARGE)
    large = large[np.argsort(-r[large])]
    words = f"Residuals of {len(large)} of {int(np.isfinite(r).sum())} taxels are more than "
    words += f"{LARGE:g} times as large as the median taxel's"
    if len(large):
        listed = (f"{ids[k]} ({significant(float(r[k]))})" for k in large[:SHOWN])
        words += f": {', '.join(listed)}" + (" and others" if len(large) > SHOWN else "")
    return {pictures[0].title: [paragraphs(f"{words}."), *map(saved_figure, pictures)]}
