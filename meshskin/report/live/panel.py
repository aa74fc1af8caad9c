"""The panel of the live page: verdict, numbers, curves and controls beside the 3D view."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from ...estimation.calibration import Calibration
from ...estimation.data.global_parameters import natural_units
from ...estimation.joint.optimum import radius_deviation
from ...estimation.online.status import DONE, KEEP_GOING
from ...estimation.uncertainty.verdict import PASS
from .. import theme
from ..plane import MM
from . import marks
from .drawing import VIEWS, Drawing
from .replay import Snapshot
from .stage import Stage

SPEEDS = (0.25, 32.0)
"""Lowest and highest speed, as multiples of real time. Chosen: single contacts can be followed, and
an hour takes two minutes."""
FORCE_WINDOW = 10.0
"""Time that the curve of the force shows, s: single pushes remain to be seen."""
MAX_POINTS = 600
"""Most points of a curve: twice the panel's width in pixels."""
CHART_HEIGHT = 100
"""Height of a curve, pixels."""
CHART_PADDING = (8, 18, 0, 0)
"""Space above, right, below and left of a curve, pixels: half a number on the axes."""
LOGARITHMIC = 3
"""uPlot's number of a logarithmic scale."""
SHOWN = 8
"""Taxels that moved whose ids are listed."""
UNITS = {"Pa": (1e-3, "kPa"), "m": (MM, "mm"), "rad": (180 / np.pi, "°")}
"""Factor and name of the unit in which the panel states one of SI."""
VERDICT_COLORS = {KEEP_GOING: theme.ESTIMATE, DONE: theme.PALETTE[1], PASS: theme.PALETTE[1]}
"""Colours of verdicts; of all others the warning's."""


class Panel:
    """The panel of a page, and what the viewer chooses in it."""

    def __init__(self, gui: Any, stage: Stage, drawing: Drawing, speed: float) -> None:
        """gui: the `gui` of a viser server; speed: of the replay at first, as a multiple of real
        time.
        """
        self.stage, self.drawing = stage, drawing
        self._nominal = stage.belief.material.effective_modulus
        curvature = stage.belief.body.closest(stage.recording.points).curvature
        self._radius_share = radius_deviation(stage.belief, curvature)
        self.row = 0
        self._history: list[tuple[float, float, float, float]] = []
        self._words = ("waiting for contacts", "")
        self.verdict = gui.add_html(_verdict(*self._words, ""))
        self.numbers = gui.add_html("")
        gui.add_html(_block(marks.legend(drawing.stage.truth is not None)))
        with gui.add_folder("Replay"):
            self._speed = gui.add_slider(
                "speed", min=SPEEDS[0], max=SPEEDS[1], step=0.25, initial_value=speed
            )
            self._paused = gui.add_checkbox("pause", initial_value=False)
            self.view = gui.add_dropdown(
                "look at", VIEWS if stage.carrier else VIEWS[:2], initial_value=drawing.view
            )
            self.magnified = gui.add_slider(
                "ellipsoids ×", min=1, max=200, step=1, initial_value=drawing.magnified
            )
        highest = float(np.max(stage.recording.force, initial=1e-3))
        top = (0.0, 1.15 * highest)
        measured = "" if stage.recording.force_measured else ", not measured"
        title = f"contact force (N), at most {highest:.3g}{measured}"
        self.force = _chart(gui, title, "time (s)", ("force",), range=top)
        sigma = "sigma of the determined taxels (mm)"
        self.sigma = _chart(gui, sigma, "contacts", ("median", "worst"), distr=LOGARITHMIC)
        residual = "residuals (in standard deviations)"
        self.residual = _chart(gui, residual, "contacts", ("rms",), range=(0.0, None))

    @property
    def speed(self) -> float:
        """Seconds of the recording per second."""
        return float(self._speed.value)

    @property
    def paused(self) -> bool:
        """Whether the replay is held."""
        return bool(self._paused.value)

    def show(self, snapshot: Snapshot) -> None:
        """Bring verdict, numbers and curves to a snapshot."""
        status, self.row = snapshot.status, snapshot.row
        self._words = (status.verdict, status.why)
        self.verdict.content = _verdict(*self._words, self._progress(snapshot))
        self.numbers.content = _table(rows_of(snapshot, self._nominal, self._radius_share))
        self._show_force(snapshot.row)
        if np.isfinite([status.median_sigma, status.residual]).all():
            sigma = (MM * status.median_sigma, MM * status.worst_sigma)
            self._history.append((snapshot.row + 1, *sigma, status.residual))
            columns = np.array(self._history[:: -(-len(self._history) // MAX_POINTS)]).T.copy()
            self.sigma.data = tuple(columns[:3])
            self.residual.data = (columns[0], columns[3])

    def conclude(self, found: Calibration) -> None:
        """Verdict and numbers of the calibration of all contacts."""
        verdict = found.verdict
        if verdict is not None:
            self._words = (verdict.level, "; ".join(verdict.reasons))
        self.verdict.content = _verdict(*self._words, "")
        self.numbers.content = _table(rows_of_all(found))

    def finish(self, words: str) -> None:
        """Say beside the verdict how it ended."""
        self.verdict.content = _verdict(*self._words, words)

    def _progress(self, snapshot: Snapshot) -> str:
        recording = self.stage.recording
        end = float(recording.time[-1] - recording.time[0])
        return f"{snapshot.time:.1f} of {end:.1f} s, contact {snapshot.row + 1:,}"

    def _show_force(self, row: int) -> None:
        recording = self.stage.recording
        first = np.searchsorted(recording.time, recording.time[row] - FORCE_WINDOW)
        rows = np.arange(first, row + 1)[:: -(-(row + 1 - first) // MAX_POINTS)]
        time = recording.time[rows] - recording.time[0]
        self.force.data = (time, np.asarray(recording.force[rows]))


def rows_of(snapshot: Snapshot, modulus: float, radius_share: float) -> list[tuple[str, str]]:
    """The numbers of a snapshot in words: what, and its value. modulus: nominal E*, Pa;
    radius_share: standard deviation of ln E* by that of the indenter's radius."""
    status, touch = snapshot.status, snapshot.status.next_touch
    rows = [
        ("taxels", f"{status.determined} determined, {status.weak} weak, {status.unseen} unseen"),
        ("sigma", f"median {_mm(status.median_sigma)}, worst {_mm(status.worst_sigma)}"),
        ("contacts", f"{status.used:,} used, {status.rejected:,} rejected"),
    ]
    if touch is None:
        rows.append(("next touch", "none"))
    else:
        x, y, z = (f"{v:.1f}".replace("-", "−") for v in MM * touch.point)
        rows.append(("next touch", f"at ({x}, {y}, {z}) mm, for taxel {touch.taxel}"))
    unknowns = dict(status.unknowns)
    if "modulus" in unknowns:
        change, statistical = unknowns["modulus"]
        unknowns["modulus"] = change, float(np.hypot(statistical, radius_share))
        modulus *= float(np.exp(change))
    for name, (value, sigma, unit) in natural_units(unknowns, modulus).items():
        scale, unit = UNITS.get(unit, (1.0, unit))
        label = "E*" if name == "modulus" else name
        rows.append((label, f"{scale * value:.4g} ± {scale * sigma:.2g} {unit}"))
    if status.undetermined:
        rows.append(("by priors only", ", ".join(status.undetermined)))
    if status.moved:
        more = "" if len(status.moved) <= SHOWN else f" and {len(status.moved) - SHOWN} more"
        rows.append(("moved", ", ".join(map(str, status.moved[:SHOWN])) + more))
    return rows


def rows_of_all(found: Calibration) -> list[tuple[str, str]]:
    """The numbers of the calibration of all contacts, as `rows_of`."""
    sigma = found.position_sigma[np.isfinite(found.positions[:, 0])]
    rows = [
        ("all contacts", "calibrated together"),
        ("taxels", f"{len(sigma)} of {len(found.ids)}"),
    ]
    if len(sigma):
        rows.append(("sigma", f"median {_mm(float(np.median(sigma)))}, worst {_mm(sigma.max())}"))
    if found.response is not None:
        rows += [("response", words) for words in found.response.describe()]
    return rows


def _mm(value: float) -> str:
    return f"{theme.significant(MM * value)} mm" if np.isfinite(value) else "–"


def _verdict(words: str, why: str, progress: str) -> str:
    color = VERDICT_COLORS.get(words, theme.WARNING)
    return _block(
        f'<div style="font-size:1.35em;font-weight:600;color:{color}">{html.escape(words)}</div>'
        f"<div>{html.escape(why)}</div>"
        f'<div style="color:{theme.MUTED}">{html.escape(progress)}</div>'
    )


def _table(rows: list[tuple[str, str]]) -> str:
    cells = "".join(
        f'<tr><td style="color:{theme.MUTED};padding-right:0.8em;vertical-align:top;'
        f'white-space:nowrap">{html.escape(name)}</td><td>{html.escape(value)}</td></tr>'
        for name, value in rows
    )
    return _block(f'<table style="border-collapse:collapse">{cells}</table>')


def _block(content: str) -> str:
    style = "padding:0.3em 1.2em 0.3em 0.8em;font-size:0.85em;line-height:1.5"
    return f'<div style="{style}">{content}</div>'


def _chart(gui: Any, title: str, x: str, names: tuple[str, ...], **scale: Any) -> Any:
    """Empty curves of `names` over x; scale: of y, as uPlot has it."""
    bare = {"show": False}
    lines = zip(names, (theme.ESTIMATE, theme.WARNING), strict=False)
    return gui.add_uplot(
        data=(np.zeros(1), *(np.full(1, np.nan) for _ in names)),
        series=({"label": x}, *({"label": n, "stroke": c, "width": 1.5} for n, c in lines)),
        title=title,
        scales={"x": {"time": False}, "y": scale},
        axes=(
            {"label": x, "size": 26, "labelSize": 14, "gap": 3, "ticks": bare},
            {"size": 44, "ticks": bare, "grid": {"show": "distr" not in scale}},
        ),
        legend={"show": len(names) > 1},
        height=CHART_HEIGHT,
        padding=CHART_PADDING,
    )
