"""The sections of the page, and its summary: one sentence, and the most important numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..estimation.uncertainty.metrics import is_ideal
from ..estimation.uncertainty.verdict import PASS
from . import advice, evidence, learned_response, scene3d
from .data import METHOD_DESCRIPTIONS, PAPER_REFERENCE, ReportData, method_name
from .figure_set import ACCURACY_TIME, RESIDUALS
from .markup import Content, SavedFigure, bullets, paragraphs, saved_figure, table, tile
from .plane import MM
from .theme import compact, grouped, significant
from .words import force_notes, modulus_words

OWN_SECTIONS = (ACCURACY_TIME, RESIDUALS, learned_response.NAME)
"""Figures that have sections of their own."""
MAX_TAXEL_ROWS = 1000
"""Most taxels that are listed one by one: the table then takes half a megabyte."""
SHOWN_ELSEWHERE = (
    "position_error_mm",
    "verdict",
    "seconds",
    "promise",
    "scene",
    "budget",
    "left_out",
    "figures_left_out",
    "undetermined",
    "modulus_pa",
    "modulus_sigma_pa",
    "worse_than_centroid",
    "response",
    "cross_validation",
    "kinematics",
    "next_touches",
)
"""Metrics that other parts of the page show."""
COST_HINT = (
    "meshskin cost SCENE measures the accuracy and the time of every setting (mesh, contact model, "
    "step, lanes, frames, estimator); meshskin run SCENE --accuracy-mm 0.1 chooses the fastest "
    "settings that reach an accuracy."
)
METRIC_NOTES = {
    "touched": "taxels with at least one reading",
    "coverage.planned": "taxels that the plan covers by contacts on several sides",
    "coverage.reached": "taxels that the run covered so",
    "coverage.given_up": "taxels that the plan covers and the run gave up",
    "contacts": "frames with contact",
    "readings": "of single taxels, above the threshold",
    "crlb_mm.mean": "Cramér-Rao bound: lowest mean error of an unbiased estimate",
    "crlb_mm.rms": "Cramér-Rao bound: lowest root mean square error",
    "nees": "squared error over stated variance: 2 if the stated uncertainty is right",
    "nees.mean": "squared error over stated variance: 2 if the stated uncertainty is right",
    "nees_band": "95 % interval of the NEES",
    "force.mean_n": "after settling",
    "force.std_n": "after settling",
    "force.overshoot": "largest force over the reference, minus one",
    "force.settling_s": "from touch until the force stays near the reference",
    "force.disturbance": "largest error while sliding, over the reference",
    "force.lost_contact_steps": "steps without contact after the first touch",
    "demonstration_mm": "mean error of the pose graph on perturbed true displacements",
    "steps": "of the closed loop",
    "steps_per_second": "of the closed loop, by computing time",
}
"""Meaning of metrics."""


def content(data: ReportData, pictures: Sequence[SavedFigure]) -> Content:
    """The whole page."""
    scene = data.provenance.get("scene") or _metadata(data).get("scene") or data.calibration.frame
    created = _format_time(str(data.provenance.get("created", "")))
    kind = "simulation with known truth" if data.truth is not None else "recording"
    verdict, steps = data.calibration.verdict, advice.next_steps(data)
    reasons = {}
    if verdict is not None:
        lists = {f"{verdict.level}:": verdict.reasons, "Not tested:": advice.untested(data)}
        reasons["Verdict"] = [bullets(first, points) for first, points in lists.items() if points]
    sections = {
        **reasons,
        "Recommendations": [bullets("", steps)] if steps else [],
        "3D view": [scene3d.section(data)],
        "Observability": advice.observability(data),
        **learned_response.section(data.calibration.response, pictures),
        "Figures": [saved_figure(p) for p in pictures if p.png.stem not in OWN_SECTIONS],
        "Numbers": _numbers(data),
        **evidence.kinematics(data),
        **evidence.validation(data),
        **evidence.residuals(data, [p for p in pictures if p.png.stem == RESIDUALS]),
        **budget(data),
        "Accuracy and time": _accuracy_time(data, pictures),
        "Taxels": [_taxels(data)],
        "Provenance": [_provenance(data)],
    }
    return Content(
        title=f"Skin calibration: {scene}" if isinstance(scene, str) else "Skin calibration",
        subtitle=" · ".join(filter(None, (kind, method_name(data.calibration.method), created))),
        summary=summary_sentence(data),
        tiles=key_numbers(data),
        sections={title: blocks for title, blocks in sections.items() if blocks},
    )


def _format_time(created: str) -> str:
    """A time of ISO 8601 for people: 2026-11-22T02:47:05+00:00 as 2026-11-22 02:47 UTC."""
    return re.sub(r"(\d)T(\d\d:\d\d):\d\d\+00:00$", r"\1 \2 UTC", created)


def _metadata(data: ReportData) -> Mapping[str, Any]:
    return {} if data.recording is None else data.recording.metadata


def _numbers(data: ReportData) -> list[str]:
    blocks = []
    if data.errors:
        rows = []
        for k, method in enumerate(data.errors):
            summary = data.error_summary(method)
            given = data.metrics.get("position_error_mm" if k == 0 else method) or {}
            summary |= {name: given[name] for name in summary if name in given}
            values = (significant(summary[s]) for s in ("mean", "rms", "max"))
            rows.append((method_name(method), *values, METHOD_DESCRIPTIONS.get(method, "")))
        header = ("position error of", "mean (mm)", "rms (mm)", "max (mm)", "")
        blocks.append(table(header, rows, numeric=(1, 2, 3)))
        if data.worse_than_centroid:
            worse = "; ".join(map(method_name, data.worse_than_centroid))
            line = f"Mean error above that of the baseline, the centroid: {worse}."
            blocks.append(paragraphs(line))
        if {"eq15", "posegraph_paper"} & set(data.errors):
            blocks.append(paragraphs(PAPER_REFERENCE))
    c = data.calibration
    if c.modulus is not None:
        sigma = "" if c.modulus_sigma is None else " (1 sigma)"
        blocks.append(paragraphs(f"Effective modulus E*: {modulus_words(c)}{sigma}."))
    rows = [row for row in c.parameter_words("±").items() if row[0] != "modulus"]
    if rows:
        blocks.append(table(("estimated with the taxels", "value ± 1 sigma"), rows, numeric=(1,)))
    shown = {*SHOWN_ELSEWHERE, *data.errors, "unknowns"}
    if is_ideal(data.calibration):  # errors of arithmetic have no covariance
        shown |= {"nees", "nees_band"}
    rest = flatten({k: v for k, v in data.metrics.items() if k not in shown})
    if rest:
        rows = [(name, value, METRIC_NOTES.get(name, "")) for name, value in rest if value]
        blocks.append(table(("metric", "value", ""), rows, numeric=(1,)))
    return blocks or [paragraphs("No metrics were given.")]


def flatten(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested mappings as rows of dotted names and values."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            rows += flatten(value, f"{name}.")
        elif isinstance(value, bool) or not isinstance(value, int | float | np.number):
            rows.append((name, _plain(value)))
        elif isinstance(value, int | np.integer):
            rows.append((name, grouped(int(value))))
        else:
            rows.append((name, compact(float(value), 5)))
    return rows


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(v) for v in value)
    if isinstance(value, float):
        return compact(value, 4)
    return "–" if value is None else str(value)


def _accuracy_time(data: ReportData, pictures: Sequence[SavedFigure]) -> list[str]:
    """Accuracy and time of the estimators, and the time of each stage."""
    blocks = [saved_figure(p) for p in pictures if p.png.stem == ACCURACY_TIME]
    promise = data.metrics.get("promise")
    if promise:
        text = f"Requested: {promise['asked']}. The pilot run chose {promise['setting']}"
        if promise["error_mm"] is not None:
            error, seconds = promise["error_mm"], promise["seconds"]
            text += f" and predicted {significant(error)} mm in {significant(seconds)} s"
        if data.truth is not None:
            text += f"; the mean error is {significant(data.main_errors['mean'])} mm"
        blocks.append(paragraphs(f"{text}."))
    if left_out := data.metrics.get("left_out"):
        names = ", ".join(map(method_name, left_out))
        blocks.append(paragraphs(f"Not compared, because there was no time: {names}."))
    if left_out := data.metrics.get("figures_left_out"):
        names = ", ".join(left_out)
        blocks.append(paragraphs(f"Not drawn, because there was no time: {names}."))
    bound = data.bound_mm or None
    rows = []
    for name, seconds in data.method_seconds.items():
        error = data.error_summary(name)["mean"] if name in data.errors else None
        ratio = significant(error / bound) if error is not None and bound else "–"
        rows.append((method_name(name), significant(error), ratio, f"{seconds:.3f}"))
    if rows:
        header = ("estimator", "mean error (mm)", "relative to the bound", "seconds")
        blocks.append(table(header, rows, numeric=(1, 2, 3)))
    hint = [] if data.truth is None else [paragraphs(COST_HINT)]
    return [*blocks, _seconds(data.seconds), *hint]


def budget(data: ReportData) -> dict[str, list[str]]:
    """The section about the decisions of an error budget, if there was one."""
    found = data.metrics.get("budget", {})
    if "table" not in found:
        return {}
    header, rows = found["table"]
    blocks = [paragraphs(*found["summary"]), table(header, rows, numeric=(2, 3))]
    return {"Error budget: simulated and neglected effects": blocks}


def _seconds(seconds: Mapping[str, float]) -> str:
    if not seconds:
        return paragraphs("No times are known.")
    total = sum(seconds.values())
    rows = [
        (stage, f"{s:.3f}", f"{100 * s / total:.0f} %" if total else "")
        for stage, s in seconds.items()
    ]
    rows.append(("all", f"{total:.3f}", ""))
    return table(("stage", "seconds", "share"), rows, numeric=(1, 2))


def _taxels(data: ReportData) -> str:
    c, error = data.calibration, data.errors.get(data.calibration.method)
    header = ["taxel", "readings", "x (mm)", "y (mm)", "z (mm)", "sigma (mm)", "chi²"]
    header += ["note"] if error is None else ["error (mm)", "note"]
    rows = []
    for k in range(min(data.count, MAX_TAXEL_ROWS)):
        position = (f"{v * MM:.4f}" if np.isfinite(v) else "–" for v in c.positions[k])
        row = [str(c.ids[k]), str(c.readings[k]), *position, significant(data.sigma[k] * MM)]
        row.append(significant(float(c.chi2[k])))
        if error is not None:
            row.append(significant(error[k] * MM))
        rows.append((*row, str(c.reasons[k])))
    shown = "" if data.count <= MAX_TAXEL_ROWS else f" (the first {MAX_TAXEL_ROWS} of {data.count})"
    return table(header, rows, range(len(header) - 1), f"All taxels{shown}")


def _provenance(data: ReportData) -> str:
    rows = flatten(data.provenance)
    keep = ("seed", "disc_radius_m", "threshold_pa")
    rows += [(f"recording.{k}", _plain(v)) for k, v in _metadata(data).items() if k in keep]
    return table(("input", "value"), rows) if rows else paragraphs("No provenance was given.")


VERDICTS = {
    "PASS": "PASS. ",
    "DOUBT": "DOUBT: check the reasons below before use. ",
    "FAIL": "FAIL: do not use this calibration. ",
}
"""What a level of a verdict means."""


def summary_sentence(data: ReportData) -> str:
    """The verdict, where the force left its reference, and one sentence about the result."""
    verdict = data.calibration.verdict
    departure = str((data.metrics.get("force") or {}).get("departure") or "")
    left = f"{departure[0].upper()}{departure[1:]}. " if departure else ""
    if verdict is None:
        return left + _result(data)
    words = VERDICTS[verdict.level]
    if verdict.level == PASS and advice.untested(data):
        words = "PASS, except for errors that this log cannot show (listed below). "
    return words + left + _result(data)


def _result(data: ReportData) -> str:
    """One sentence about the result."""
    located = int(data.located.sum())
    found = f"All {located}" if located == data.count else f"{located} of {data.count}"
    if not located:
        return f"None of the {data.count} taxels was located."
    if data.truth is None:
        typical = np.nanmedian(data.sigma) * MM if np.isfinite(data.sigma).any() else np.nan
        return (
            f"{found} taxels were located; the stated uncertainty is {significant(typical)} mm "
            "(median standard deviation). There is no truth to compare with."
        )
    mean = significant(data.main_errors["mean"])
    text = f"{found} taxels were located with a mean error of {mean} mm"
    if is_ideal(data.calibration):
        text += ", from readings without noise"
    ratio = advice.bound_ratio(data)
    if ratio is not None:
        text += f", {significant(ratio)} times the Cramér-Rao bound"
    return text + "."


def key_numbers(data: ReportData) -> list[str]:
    """The most important numbers."""
    c = data.calibration
    note = f"{grouped(int(np.sum(c.readings)))} readings"
    out = [tile("Taxels touched", f"{data.touched.sum()}", f"of {data.count}", note)]
    if data.truth is not None:
        errors = data.main_errors
        note = f"rms {significant(errors['rms'])}, max {significant(errors['max'])} mm"
        out.append(tile("Mean position error", significant(errors["mean"]), "mm", note))
        if data.bound_mm:
            note = "lowest mean error of an unbiased estimate"
            out.append(tile("Cramér-Rao bound", significant(data.bound_mm), "mm", note))
    s = data.finite_sigma_mm
    if len(s):
        note = f"standard deviation, median; largest {significant(s.max())} mm"
        out.append(tile("Stated uncertainty", significant(float(np.median(s))), "mm", note))
    out += _force(data)
    if data.seconds:
        note = f"longest stage: {max(data.seconds, key=lambda k: data.seconds[k])}"
        out.append(tile("Time", significant(sum(data.seconds.values())), "s", note))
    return out


def _force(data: ReportData) -> list[str]:
    """The contact force: from the metrics, or else from the recording."""
    force = data.metrics.get("force") or {}
    if not force and data.recording is not None and len(data.recording.force):
        f = data.recording.force
        if not data.recording.force_measured:
            return [tile("Contact force", "not recorded", "", "estimated relative to its median")]
        note = f"standard deviation {significant(float(f.std()), 2)} N"
        return [tile("Mean contact force", f"{f.mean():.3f}", "N", note)]
    if not force:
        return []
    mean = force.get("mean_n")
    value = "–" if mean is None else f"{mean:.3f}"
    return [tile("Mean contact force", value, "N", ", ".join(force_notes(force)))]
