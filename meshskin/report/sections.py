"""The sections of the page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import advice, scene3d
from .data import METHOD_DESCRIPTIONS, PAPER_REFERENCE, ReportData, method_name
from .figure_set import ACCURACY_TIME
from .markup import Block, Content, SavedFigure, Section, Table, Text, View3D
from .plane import MM
from .summary import key_numbers, summary_sentence
from .theme import compact, grouped, significant

if TYPE_CHECKING:
    from ..geometry.body import Body

MAX_TAXEL_ROWS = 1000
"""Most taxels that are listed one by one: the table then takes half a megabyte."""
SHOWN_ELSEWHERE = (
    "position_error_mm",
    "verdict",
    "seconds",
    "promise",
    "scene",
    "budget",
    "undetermined",
    "modulus_pa",
    "modulus_sigma_pa",
)
"""Metrics that other parts of the page show."""
COST_HINT = (
    "meshskin cost SCENE measures the accuracy and the time of every setting (mesh, contact model, "
    "step, lanes, frames, estimator); meshskin run SCENE --accuracy-mm 0.1 chooses the fastest "
    "settings that reach an accuracy."
)
METRIC_NOTES = {
    "touched": "taxels with at least one reading",
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
    "steps_per_second": "of the closed loop with arm dynamics",
}
"""Meaning of metrics."""


def content(data: ReportData, pictures: Sequence[SavedFigure], body: Body | None) -> Content:
    """The whole page."""
    provenance = data.provenance
    scene = provenance.get("scene") or _metadata(data).get("scene")
    created = provenance.get("created", "")
    kind = "simulation with known truth" if data.truth is not None else "recording"
    return Content(
        title=f"Skin calibration: {scene}" if isinstance(scene, str) else "Skin calibration",
        subtitle=" · ".join(
            part
            for part in (kind, method_name(data.calibration.method), _format_time(str(created)))
            if part
        ),
        summary=summary_sentence(data),
        numbers=key_numbers(data),
        sections=(
            *verdict(data),
            Section("Observability", advice.observability(data)),
            Section("Recommendations", (Text(("", *advice.next_steps(data)), listed=True),)),
            Section("3D view", (_view(data, body),)),
            Section("Figures", tuple(p for p in pictures if p.png.stem != ACCURACY_TIME)),
            Section("Numbers", _numbers(data)),
            *budget(data),
            Section("Accuracy and time", _accuracy_time(data, pictures)),
            Section("Taxels", (_taxels(data),)),
            Section("Provenance", _provenance(data)),
        ),
    )


def verdict(data: ReportData) -> tuple[Section, ...]:
    """The reasons of the verdict, where there are any."""
    found = data.calibration.verdict
    if found is None or not found.reasons:
        return ()
    return (Section("Verdict", (Text((f"{found.level}:", *found.reasons), listed=True),)),)


def _format_time(created: str) -> str:
    """A time of ISO 8601 for people: 2026-11-22T02:47:05+00:00 as 2026-11-22 02:47 UTC."""
    return re.sub(r"(\d)T(\d\d:\d\d):\d\d\+00:00$", r"\1 \2 UTC", created)


def _metadata(data: ReportData) -> Mapping[str, Any]:
    return {} if data.recording is None else data.recording.metadata


def _view(data: ReportData, body: Body | None) -> View3D:
    c = data.calibration
    figure = scene3d.view_3d(
        ids=c.ids,
        poses=c.poses,
        covariances=data.covariances,
        mesh=None if body is None else (body.facets.vertices, body.facets.faces),
        truth=data.truth,
        path=None if data.recording is None else data.recording.points,
        heading_observed=bool(np.any(np.asarray(c.observed)[:, 5])),
    )
    caption = (
        "Drag to rotate, scroll to zoom, click a legend entry to hide or show it; point at a taxel "
        "to see its numbers. Frames: x red, y green, z (outward) blue. Ellipsoids: stated 1 sigma "
        "along the skin, enlarged by the factor in the legend."
    )
    if body is not None and len(body.facets.faces) > scene3d.MAX_FACES:
        caption += " The mesh of the body is simplified away from the skin."
    return View3D(figure, caption)


def _numbers(data: ReportData) -> tuple[Block, ...]:
    blocks: list[Block] = []
    if data.errors:
        rows = []
        for k, method in enumerate(data.errors):
            summary = data.error_summary(method)
            given = data.metrics.get("position_error_mm" if k == 0 else method) or {}
            summary |= {name: given[name] for name in summary if name in given}
            values = (significant(summary[s]) for s in ("mean", "rms", "max"))
            rows.append((method_name(method), *values, METHOD_DESCRIPTIONS.get(method, "")))
        header = ("position error of", "mean (mm)", "rms (mm)", "max (mm)", "")
        blocks.append(Table(header, tuple(rows), numeric=(1, 2, 3)))
        if "posegraph_paper" in data.errors:
            blocks.append(Text((PAPER_REFERENCE,)))
    c = data.calibration
    if c.modulus is not None:
        value = significant(c.modulus / 1e3, 6)
        if c.modulus_sigma is None:
            line = f"Effective modulus E*, given: {value} kPa."
        else:
            sigma = significant(c.modulus_sigma / 1e3)
            line = f"Effective modulus E*, estimated: {value} ± {sigma} (1 sigma) kPa."
        blocks.append(Text((line,)))
    shown = {*SHOWN_ELSEWHERE, *data.errors}
    rest = flatten({k: v for k, v in data.metrics.items() if k not in shown})
    if rest:
        rows = [(name, value, METRIC_NOTES.get(name, "")) for name, value in rest]
        blocks.append(Table(("metric", "value", ""), tuple(rows), numeric=(1,)))
    return tuple(blocks) or (Text(("No metrics were given.",)),)


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


def _accuracy_time(data: ReportData, pictures: Sequence[SavedFigure]) -> tuple[Block, ...]:
    """Accuracy and time of the estimators, and the time of each stage."""
    blocks: list[Block] = [p for p in pictures if p.png.stem == ACCURACY_TIME]
    promise = data.metrics.get("promise")
    if promise:
        text = (
            f"Requested: {promise['asked']}. The pilot run chose {promise['setting']} and predicted"
            f" {significant(promise['error_mm'])} mm in {significant(promise['seconds'])} s"
        )
        if data.truth is not None:
            text += f"; the mean error is {significant(data.main_errors['mean'])} mm"
        blocks.append(Text((f"{text}.",)))
    bound = data.bound_mm or None
    rows = []
    for name, seconds in data.method_seconds.items():
        error = data.error_summary(name)["mean"] if name in data.errors else None
        ratio = significant(error / bound) if error is not None and bound else "–"
        rows.append((method_name(name), significant(error), ratio, f"{seconds:.3f}"))
    if rows:
        header = ("estimator", "mean error (mm)", "relative to the bound", "seconds")
        blocks.append(Table(header, tuple(rows), numeric=(1, 2, 3)))
    return (*blocks, _seconds(data.seconds), Text((COST_HINT,)))


def budget(data: ReportData) -> tuple[Section, ...]:
    """The decisions of an error budget, if there was one."""
    if data.budget is None:
        return ()
    header, rows = data.budget.table()
    blocks = Text(data.budget.summary()), Table(header, rows, numeric=(2, 3))
    return (Section("Error budget: simulated and neglected effects", blocks),)


def _seconds(seconds: Mapping[str, float]) -> Block:
    if not seconds:
        return Text(("No times are known.",))
    total = sum(seconds.values())
    rows = [
        (stage, f"{s:.3f}", f"{100 * s / total:.0f} %" if total else "")
        for stage, s in seconds.items()
    ]
    rows.append(("all", f"{total:.3f}", ""))
    return Table(("stage", "seconds", "share"), tuple(rows), numeric=(1, 2))


def _taxels(data: ReportData) -> Block:
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
    return Table(
        tuple(header),
        tuple(rows),
        numeric=tuple(range(len(header) - 1)),
        collapsed=f"All taxels{shown}",
    )


def _provenance(data: ReportData) -> tuple[Block, ...]:
    rows = flatten(data.provenance)
    keep = ("seed", "disc_radius_m", "threshold_pa")
    rows += [(f"recording.{k}", _plain(v)) for k, v in _metadata(data).items() if k in keep]
    if not rows:
        return (Text(("No provenance was given.",)),)
    return (Table(("input", "value"), tuple(rows)),)
