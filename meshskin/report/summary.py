"""What the page says first: the verdict in a sentence, and the numbers to read in ten seconds."""

from __future__ import annotations

import numpy as np

from . import advice
from .data import ReportData
from .markup import Number
from .plane import MM
from .theme import count, measured, number


def main_errors(findings: ReportData) -> dict[str, float] | None:
    """Mean, rms and max error (mm) of the calibration: from the metrics, or else computed."""
    if findings.truth is None:
        return None
    given = findings.metrics.get("position_error_mm")
    return dict(given) if given else findings.error_summary(findings.calibration.method)


def verdict(findings: ReportData) -> str:
    """One sentence that says how it went."""
    located = int(findings.located.sum())
    whole = located == findings.count
    found = f"All {located}" if whole else f"{located} of {findings.count}"
    errors = main_errors(findings)
    if errors is None:
        typical = np.nanmedian(findings.sigma) * MM if np.isfinite(findings.sigma).any() else np.nan
        return (
            f"{found} taxels were located; the stated uncertainty is {measured(typical)} mm "
            "(median standard deviation). There is no truth to compare with."
        )
    mean = measured(errors["mean"])
    text = f"{found} taxels were located with a mean error of {mean} mm"
    if advice.is_noiseless(findings):
        text += ", from readings without noise"
    ratio = advice.bound_ratio(findings)
    if ratio is not None:
        text += f", {measured(ratio)} times what the Cramér-Rao bound lets one expect"
    return text + "."


def numbers(findings: ReportData) -> tuple[Number, ...]:
    """The tiles."""
    c = findings.calibration
    touched = int(findings.touched.sum())
    readings = int(np.sum(c.readings))
    note = f"{count(readings)} readings"
    tiles = [Number("Taxels touched", f"{touched}", f"of {findings.count}", note)]
    errors = main_errors(findings)
    if errors is not None:
        note = f"rms {measured(errors['rms'])}, max {measured(errors['max'])} mm"
        tiles.append(Number("Mean position error", measured(errors["mean"]), "mm", note))
        bound = findings.metrics.get("crlb_mm", {}).get("mean")
        if bound:
            note = "mean error that the readings allow at best"
            tiles.append(Number("Cramér-Rao bound", measured(bound), "mm", note))
    s = findings.sigma[np.isfinite(findings.sigma)] * MM
    if len(s):
        note = f"standard deviation, median; largest {measured(s.max())} mm"
        tiles.append(Number("Stated uncertainty", measured(float(np.median(s))), "mm", note))
    tiles += _force(findings)
    if findings.seconds:
        slowest = max(findings.seconds, key=lambda k: findings.seconds[k])
        note = f"most of it: {slowest}"
        tiles.append(Number("Time", measured(sum(findings.seconds.values())), "s", note))
    return tuple(tiles)


def _force(findings: ReportData) -> list[Number]:
    force = findings.metrics.get("force") or {}
    if not force and findings.recording is not None and len(findings.recording.force):
        f = findings.recording.force
        note = f"standard deviation {measured(float(f.std()), 2)} N"
        return [Number("Mean contact force", f"{f.mean():.3f}", "N", note)]
    if not force:
        return []
    notes = [f"reference {number(force['reference_n'])} N"] if "reference_n" in force else []
    if force.get("settling_s") is not None:
        notes.append(f"settled in {number(force['settling_s'] * 1e3)} ms")
    if force.get("overshoot") is not None:
        over = 100 * force["overshoot"]
        notes.append(f"overshoot {over:.1f} %" if over >= 0.05 else "no overshoot")
    mean = force.get("mean_n")
    shown = "–" if mean is None else f"{mean:.3f}"
    return [Number("Mean contact force", shown, "N", ", ".join(notes))]
