"""The section about a cross-validation: how well held-out contacts are localised.

It is what a report on a real recording has in place of errors: no truth is needed.
"""

from __future__ import annotations

from .data import ReportData
from .markup import paragraphs, table
from .theme import compact, significant

TITLE = "Held-out contacts"


def sections(data: ReportData) -> dict[str, list[str]]:
    """The section about contacts that were held out, if there was a cross-validation."""
    m = data.metrics.get("cross_validation")
    if m is None:
        return {}
    if not m["localized"]:
        return {TITLE: [paragraphs("No held-out contact was read by three taxels.")]}
    rows = [
        (name, *(significant(m[key][s]) for s in ("rms", "p95")))
        for name, key in (
            ("maximum likelihood", "error_mm"),
            ("centroid of the taxels that read", "centroid_error_mm"),
        )
    ]
    words = (
        f"Contacts were held out in {m['folds']} folds, in blocks of consecutive ones, and "
        "localised from their readings alone by the skin calibrated on the others: "
        f"{m['localized']} of {m['contacts']} contacts, the others having been read by fewer than "
        "three taxels. The error is the distance from the recorded contact point, whose own error "
        "it contains.",
        f"Taxel pitch: {significant(m['taxel_pitch_mm'])} mm. Log likelihood of held-out readings: "
        f"{compact(m['log_likelihood_per_reading'], 4)} per reading, in the recorded unit; it "
        "compares calibrations of the same recording.",
    )
    header = ("contacts localised by", "rms error (mm)", "95th percentile (mm)")
    return {TITLE: [table(header, rows, numeric=(1, 2)), paragraphs(*words)]}
