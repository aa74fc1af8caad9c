"""What the page says, section by section."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import advice, scene3d
from .data import METHODS, PAPER, ReportData, readable
from .figure_set import ACCURACY_TIME
from .markup import Block, Content, Picture, Section, Table, Text, View
from .plane import MM
from .summary import main_errors, numbers, verdict
from .theme import count, measured, number

if TYPE_CHECKING:
    from ..geometry.body import Body

ROWS = 1000
"""The most taxels that the page lists one by one."""
SAID = (
    "position_error_mm",
    "seconds",
    "promise",
    "scene",
    "budget",
    "undetermined",
    "modulus_pa",
    "modulus_sigma_pa",
)
"""Metrics that the page says elsewhere."""
MORE = (
    "meshskin cost SCENE measures what every knob (mesh, contact model, step, lanes, frames, "
    "estimator) buys and costs; meshskin run SCENE --accuracy-mm 0.1 takes the cheapest way there."
)
EXPLAINED = {
    "touched": "taxels that answered at all",
    "contacts": "frames in which the indenter touched",
    "readings": "of single taxels, above the threshold",
    "crlb_mm.mean": "least mean error to expect of any unbiased estimate (Cramér-Rao)",
    "crlb_mm.rms": "the same, root mean square",
    "nees": "squared error over stated variance: 2 where the stated uncertainty is right",
    "nees.mean": "squared error over stated variance: 2 where the stated uncertainty is right",
    "nees_band": "where it lies in 95 of 100 runs",
    "force.mean_n": "after settling",
    "force.std_n": "after settling",
    "force.overshoot": "largest force over the reference, less one",
    "force.settling_s": "from touch until the force stays near the reference",
    "force.disturbance": "largest error while sliding, over the reference",
    "force.lost_contact_steps": "steps without contact after the first touch",
    "demonstration_mm": "mean error of the pose graph on perturbed true displacements",
    "steps": "of the closed loop",
    "steps_per_second": "closed loop with arm dynamics",
}
"""What well-known metrics mean."""


def content(findings: ReportData, pictures: Sequence[Picture], body: Body | None) -> Content:
    """The whole page."""
    provenance = findings.provenance
    scene = provenance.get("scene") or _metadata(findings).get("scene")
    created = provenance.get("created", "")
    kind = "simulation, compared with its truth" if findings.truth is not None else "recording"
    return Content(
        title=f"Skin calibration: {scene}" if isinstance(scene, str) else "Skin calibration",
        subtitle=" · ".join(
            part
            for part in (kind, readable(findings.calibration.method), _moment(str(created)))
            if part
        ),
        verdict=verdict(findings),
        numbers=numbers(findings),
        sections=(
            Section("What was determined, and what was not", advice.determined(findings)),
            Section("What to do next", (Text(("", *advice.next_steps(findings)), listed=True),)),
            Section("The skin in space", (_view(findings, body),)),
            Section("Figures", tuple(p for p in pictures if p.png.stem != ACCURACY_TIME)),
            Section("Numbers", _numbers(findings)),
            *budget(findings),
            Section("Accuracy against time", _accuracy_time(findings, pictures)),
            Section("Taxels", (_taxels(findings),)),
            Section("Provenance", _provenance(findings)),
        ),
    )


def _moment(created: str) -> str:
    """A time of ISO 8601 for people: 2026-11-22T02:47:05+00:00 as 2026-11-22 02:47 UTC."""
    return re.sub(r"(\d)T(\d\d:\d\d):\d\d\+00:00$", r"\1 \2 UTC", created)


def _metadata(findings: ReportData) -> Mapping[str, Any]:
    return {} if findings.recording is None else findings.recording.metadata


def _view(findings: ReportData, body: Body | None) -> View:
    c = findings.calibration
    figure = scene3d.view(
        ids=c.ids,
        poses=c.poses,
        covariances=findings.covariances,
        mesh=None if body is None else (body.facets.vertices, body.facets.faces),
        truth=findings.truth,
        path=None if findings.recording is None else findings.recording.points,
        heading_observed=bool(np.any(np.asarray(c.observed)[:, 5])),
    )
    caption = (
        "Drag to turn, scroll to come nearer, click a legend entry to hide or show it; point at a "
        "taxel for its numbers. Frames: x red, y green, z (outward) blue. Ellipsoids are the "
        "stated 1 sigma along the skin, enlarged as the legend says."
    )
    if body is not None and len(body.facets.faces) > scene3d.FACES:
        caption += " Away from the skin the body is drawn more coarsely than it is."
    return View(figure, caption)


def _numbers(findings: ReportData) -> tuple[Block, ...]:
    blocks: list[Block] = []
    if findings.errors:
        rows = []
        for k, method in enumerate(findings.errors):
            summary = findings.error_summary(method)
            given = findings.metrics.get("position_error_mm" if k == 0 else method) or {}
            summary |= {name: given[name] for name in summary if name in given}
            values = (measured(summary[s]) for s in ("mean", "rms", "max"))
            rows.append((readable(method), *values, METHODS.get(method, "")))
        header = ("position error of", "mean (mm)", "rms (mm)", "max (mm)", "")
        blocks.append(Table(header, tuple(rows), numeric=(1, 2, 3)))
        if "posegraph_paper" in findings.errors:
            blocks.append(Text((PAPER,)))
    c = findings.calibration
    if c.modulus is not None:
        how, sigma = "given", ""
        if c.modulus_sigma is not None:
            how, sigma = (
                "estimated with the taxels",
                f" ± {measured(c.modulus_sigma / 1e3)} (1 sigma)",
            )
        value = f"{measured(c.modulus / 1e3, 6)}{sigma} kPa"
        blocks.append(Text((f"Effective modulus E*, {how}: {value}.",)))
    shown = {*SAID, *findings.errors}
    rest = flatten({k: v for k, v in findings.metrics.items() if k not in shown})
    if rest:
        rows = [(name, value, EXPLAINED.get(name, "")) for name, value in rest]
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
            rows.append((name, count(int(value))))
        else:
            rows.append((name, number(float(value), 5)))
    return rows


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(v) for v in value)
    if isinstance(value, float):
        return number(value, 4)
    return "–" if value is None else str(value)


def _accuracy_time(findings: ReportData, pictures: Sequence[Picture]) -> tuple[Block, ...]:
    """What this run's accuracy cost, from its own figures."""
    blocks: list[Block] = [p for p in pictures if p.png.stem == ACCURACY_TIME]
    promise = findings.metrics.get("promise")
    if promise:
        text = (
            f"Asked for {promise['asked']}. The pilot run chose {promise['setting']} and promised "
            f"{measured(promise['error_mm'])} mm in {measured(promise['seconds'])} s"
        )
        errors = main_errors(findings)
        text += f"; the taxels came to {measured(errors['mean'])} mm." if errors else "."
        blocks.append(Text((text,)))
    bound = findings.metrics.get("crlb_mm", {}).get("mean") or None
    rows = []
    for name, seconds in findings.estimating.items():
        error = findings.error_summary(name)["mean"] if name in findings.errors else None
        ratio = measured(error / bound) if error is not None and bound else "–"
        rows.append((readable(name), measured(error), ratio, f"{seconds:.3f}"))
    if rows:
        header = ("estimator", "mean error (mm)", "times the bound", "seconds")
        blocks.append(Table(header, tuple(rows), numeric=(1, 2, 3)))
    return (*blocks, _seconds(findings.seconds), Text((MORE,)))


def budget(findings: ReportData) -> tuple[Section, ...]:
    """What an error budget decided, where there was one."""
    if findings.ledger is None:
        return ()
    header, rows = findings.ledger.table()
    blocks = Text(findings.ledger.summary()), Table(header, rows, numeric=(2, 3))
    return (Section("What was simulated, and what was left out", blocks),)


def _seconds(seconds: Mapping[str, float]) -> Block:
    if not seconds:
        return Text(("No times were kept.",))
    total = sum(seconds.values())
    rows = [
        (stage, f"{s:.3f}", f"{100 * s / total:.0f} %" if total else "")
        for stage, s in seconds.items()
    ]
    rows.append(("all", f"{total:.3f}", ""))
    return Table(("stage", "seconds", "share"), tuple(rows), numeric=(1, 2))


def _taxels(findings: ReportData) -> Block:
    c, error = findings.calibration, findings.errors.get(findings.calibration.method)
    header = ["taxel", "readings", "x (mm)", "y (mm)", "z (mm)", "sigma (mm)", "chi²"]
    header += ["note"] if error is None else ["error (mm)", "note"]
    rows = []
    for k in range(min(findings.count, ROWS)):
        place = (f"{v * MM:.4f}" if np.isfinite(v) else "–" for v in c.positions[k])
        row = [str(c.ids[k]), str(c.readings[k]), *place, measured(findings.sigma[k] * MM)]
        row.append(measured(float(c.chi2[k])))
        if error is not None:
            row.append(measured(error[k] * MM))
        rows.append((*row, str(c.reasons[k])))
    shown = "" if findings.count <= ROWS else f" (the first {ROWS} of {findings.count})"
    return Table(
        tuple(header),
        tuple(rows),
        numeric=tuple(range(len(header) - 1)),
        folded=f"Every taxel in numbers{shown}",
    )


def _provenance(findings: ReportData) -> tuple[Block, ...]:
    rows = flatten(findings.provenance)
    keep = ("seed", "disc_radius_m", "threshold_pa")
    rows += [(f"recording.{k}", _plain(v)) for k, v in _metadata(findings).items() if k in keep]
    if not rows:
        return (Text(("No provenance was given.",)),)
    return (Table(("input", "value"), tuple(rows)),)
