"""What the data determined, what they did not, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from .data import ReportData, has_gauge
from .markup import Block, Table, Text
from .plane import MM
from .theme import measured

FREEDOMS = (
    "position along the skin, taxel x",
    "position along the skin, taxel y",
    "position along the normal",
    "tilt about taxel x",
    "tilt about taxel y",
    "heading: rotation about the normal",
)
FEW_READINGS = 12
"""Fewer readings than this leave a taxel's position weak."""
NO_NOISE = 1e-4
"""Stated uncertainties (mm) below this come from ideal data."""
SUSPECT_CHI2 = 3.0
"""Residuals this many times the typical taxel's are not noise."""
FAR_FROM_BOUND = 1.5
"""Errors this many times the Cramér-Rao expectation are not noise alone."""


def listed(ids: Iterable[object], most: int = 20) -> str:
    """Ids as text: 3, 17, 41 and 5 more."""
    names = [str(k) for k in ids]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def bound_ratio(findings: ReportData) -> float | None:
    """Mean error over the Cramér-Rao expectation; None if one of them is not known."""
    bound = (findings.metrics.get("crlb_mm") or {}).get("mean")
    given = findings.metrics.get("position_error_mm") or {}
    if findings.truth is None or bound is None or not np.isfinite(bound) or bound <= 0:
        return None
    mean = given.get("mean", findings.error_summary(findings.calibration.method)["mean"])
    return float(mean / bound)


def determined(findings: ReportData) -> tuple[Block, ...]:
    """Degrees of freedom, factors, anchor, and the taxels that are not there."""
    c = findings.calibration
    observed = np.asarray(c.observed, dtype=bool)
    touched = int(findings.touched.sum())
    counts = observed[findings.touched].sum(axis=0) if touched else np.zeros(6, dtype=int)
    rows = tuple(
        (name, f"{int(n)} of {touched}", _comment(k, int(n), touched))
        for k, (name, n) in enumerate(zip(FREEDOMS, counts, strict=True))
    )
    lines = [
        f"Factors used: {'; '.join(c.factors) or 'none named'}.",
        f"Anchor (what fixes the whole's pose): {c.anchor or 'none named'}.",
    ]
    if has_gauge(c) and findings.truth is not None:
        lines.append(
            "This method leaves the pose of the whole free: errors are given after the best "
            "rigid alignment with the truth."
        )
    lines += missing(findings)
    header = ("degree of freedom", "touched taxels", "")
    return (Table(header, rows, numeric=(1,)), Text(tuple(lines)))


def missing(findings: ReportData) -> list[str]:
    """Which taxels have no estimate, and why."""
    c = findings.calibration
    why = np.where(findings.located, "", np.asarray(c.reasons, dtype=str))
    reasons = sorted(set(why[~findings.located].tolist()))
    if not reasons:
        return ["Every taxel was touched and located."]
    many = {reason: int((why == reason).sum()) for reason in reasons}
    return [
        f"{many[reason]} of {findings.count} taxels {'have' if many[reason] > 1 else 'has'} "
        f"no estimate ({reason or 'no reason given'}): "
        f"{listed(np.asarray(c.ids)[why == reason])}."
        for reason in reasons
    ]


def _comment(freedom: int, count: int, touched: int) -> str:
    if count == touched:
        return "determined"
    if freedom == 5 and count == 0:
        return (
            "not determined: a round taxel reads the same however it is turned about its normal; "
            "the frame's heading is a convention"
        )
    if count == 0:
        return "not determined by these data; no number is given"
    return f"not determined for {touched - count} taxels"


def next_steps(findings: ReportData) -> Sequence[str]:
    """Advice that follows from the numbers, most urgent first."""
    steps = [*_contacts(findings), *_misfit(findings), *_noise(findings)]
    if not np.asarray(findings.calibration.observed, dtype=bool)[:, 5].any():
        steps.append(
            "If the headings matter, take them from the known layout of the skin's modules: "
            "no contact with a round taxel shows them."
        )
    if findings.truth is None:
        steps.append(
            "To see what error to expect, simulate this body, path and noise, and compare that "
            "report's errors with the uncertainty stated here."
        )
    return tuple(steps)


def _contacts(findings: ReportData) -> list[str]:
    """Where contacts are missing."""
    c = findings.calibration
    ids, steps = np.asarray(c.ids), []
    if not findings.touched.all():
        steps.append(
            f"Extend the contact path to taxels {listed(ids[~findings.touched])}, "
            "or mark them as defective."
        )
    weak = findings.touched & ~np.asarray(c.observed, dtype=bool)[:, :2].all(axis=1)
    if weak.any():
        steps.append(
            f"Pass taxels {listed(ids[weak])} on both sides: they were touched, but from too few "
            "sides to determine their place along the skin."
        )
    few = findings.touched & ~weak & (np.asarray(c.readings) < FEW_READINGS)
    if few.any():
        steps.append(
            f"Press these taxels more often (fewer than {FEW_READINGS} readings each): "
            f"{listed(ids[few])}."
        )
    return steps


def _misfit(findings: ReportData) -> list[str]:
    """What the readings say that the model does not."""
    steps = []
    bad = suspects(findings)
    if bad.any():
        steps.append(
            f"Check taxels {listed(np.asarray(findings.calibration.ids)[bad])}: their residuals "
            "are far above the others' (a wrong gain, a neighbour's wiring, or an estimate caught "
            "in a wrong place)."
        )
    ratio = bound_ratio(findings)
    if ratio is not None and ratio > FAR_FROM_BOUND:
        steps.append(
            f"The error is {measured(ratio)} times the Cramér-Rao expectation: look for what the "
            "model leaves out (contact model, indenter offset, gains) before recording more."
        )
    return steps


def is_noiseless(findings: ReportData) -> bool:
    """Whether the stated uncertainty is next to nothing."""
    s = findings.sigma[np.isfinite(findings.sigma)] * MM
    return bool(len(s) and np.median(s) < NO_NOISE)


def _noise(findings: ReportData) -> list[str]:
    """What the stated uncertainty calls for."""
    s = findings.sigma[np.isfinite(findings.sigma)] * MM
    if not len(s):
        return []
    if is_noiseless(findings):
        return [
            "These data are all but free of noise: simulate with the noise of the sensor, to see "
            "what error to expect."
        ]
    return [
        *_consistency(findings),
        f"To halve the uncertainty of {measured(float(np.median(s)))} mm, record four times as "
        "many readings, or halve the sensor noise.",
    ]


def _consistency(findings: ReportData) -> list[str]:
    """What to do where the errors do not match the stated uncertainty."""
    from ..estimation.uncertainty.metrics import nees_band

    given = findings.metrics.get("nees")
    mean = given.get("mean") if isinstance(given, Mapping) else given
    count = int(findings.located.sum())
    if findings.truth is None or mean is None or not count:
        return []
    low, high = nees_band(count)
    if not np.isfinite(mean) or low <= mean <= high:
        return []
    side = "too small" if mean > high else "too large"
    return [
        f"The stated uncertainty is {side}: NEES {measured(float(mean))} lies outside its 95 % "
        f"band {measured(low)} to {measured(high)} (by chance in 1 run of 20). Check the noise "
        "that the calibration was told, and what its model leaves out."
    ]


def suspects(findings: ReportData) -> np.ndarray:
    """Taxels (n,) whose chi-square lies far above the others'."""
    chi2 = np.asarray(findings.calibration.chi2, dtype=float)
    good = np.isfinite(chi2) & findings.touched
    if not good.any():
        return np.zeros(findings.count, dtype=bool)
    typical = max(float(np.median(chi2[good])), 1.0)
    return np.asarray(good & (np.where(good, chi2, 0.0) > SUSPECT_CHI2 * typical))
