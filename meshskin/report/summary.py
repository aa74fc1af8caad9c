"""The summary of the page: one sentence, and the most important numbers."""

from __future__ import annotations

import numpy as np

from . import advice
from .data import ReportData
from .markup import KeyNumber
from .plane import MM
from .theme import compact, grouped, significant

VERDICTS = {
    "PASS": "PASS. ",
    "DOUBT": "DOUBT: check the reasons below before use. ",
    "FAIL": "FAIL: do not use this calibration. ",
}
"""What a level of a verdict means."""


def summary_sentence(data: ReportData) -> str:
    """The verdict, and one sentence about the result."""
    verdict = data.calibration.verdict
    return ("" if verdict is None else VERDICTS[verdict.level]) + _result(data)


def _result(data: ReportData) -> str:
    """One sentence about the result."""
    located = int(data.located.sum())
    found = f"All {located}" if located == data.count else f"{located} of {data.count}"
    if data.truth is None:
        typical = np.nanmedian(data.sigma) * MM if np.isfinite(data.sigma).any() else np.nan
        return (
            f"{found} taxels were located; the stated uncertainty is {significant(typical)} mm "
            "(median standard deviation). There is no truth to compare with."
        )
    mean = significant(data.main_errors["mean"])
    text = f"{found} taxels were located with a mean error of {mean} mm"
    if advice.is_noiseless(data):
        text += ", from readings without noise"
    ratio = advice.bound_ratio(data)
    if ratio is not None:
        text += f", {significant(ratio)} times the Cramér-Rao bound"
    return text + "."


def key_numbers(data: ReportData) -> tuple[KeyNumber, ...]:
    """The most important numbers."""
    c = data.calibration
    note = f"{grouped(int(np.sum(c.readings)))} readings"
    out = [KeyNumber("Taxels touched", f"{data.touched.sum()}", f"of {data.count}", note)]
    if data.truth is not None:
        errors = data.main_errors
        note = f"rms {significant(errors['rms'])}, max {significant(errors['max'])} mm"
        out.append(KeyNumber("Mean position error", significant(errors["mean"]), "mm", note))
        if data.bound_mm:
            note = "lowest mean error of an unbiased estimate"
            out.append(KeyNumber("Cramér-Rao bound", significant(data.bound_mm), "mm", note))
    s = data.finite_sigma_mm
    if len(s):
        note = f"standard deviation, median; largest {significant(s.max())} mm"
        out.append(KeyNumber("Stated uncertainty", significant(float(np.median(s))), "mm", note))
    out += _force(data)
    if data.seconds:
        slowest = max(data.seconds, key=lambda k: data.seconds[k])
        note = f"longest stage: {slowest}"
        out.append(KeyNumber("Time", significant(sum(data.seconds.values())), "s", note))
    return tuple(out)


def _force(data: ReportData) -> list[KeyNumber]:
    """The contact force: from the metrics, or else from the recording."""
    force = data.metrics.get("force") or {}
    if not force and data.recording is not None and len(data.recording.force):
        f = data.recording.force
        note = f"standard deviation {significant(float(f.std()), 2)} N"
        return [KeyNumber("Mean contact force", f"{f.mean():.3f}", "N", note)]
    if not force:
        return []
    notes = [f"reference {compact(force['reference_n'])} N"] if "reference_n" in force else []
    if force.get("settling_s") is not None:
        notes.append(f"settled in {compact(force['settling_s'] * 1e3)} ms")
    if force.get("overshoot") is not None:
        over = 100 * force["overshoot"]
        notes.append(f"overshoot {over:.1f} %" if over >= 0.05 else "no overshoot")
    mean = force.get("mean_n")
    value = "–" if mean is None else f"{mean:.3f}"
    return [KeyNumber("Mean contact force", value, "N", ", ".join(notes))]
