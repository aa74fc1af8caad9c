"""Accuracy and time: the work-precision plot with its Pareto front, and the page of cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from . import markup, theme
from .data import method_name
from .markup import Content, SavedFigure, paragraphs, tile
from .theme import significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..study.sensitivity.cost import Costs
    from ..study.sensitivity.trial import Row

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
COLOURS = (*theme.PALETTE, theme.WARNING, theme.TRUTH)
KNOB_NAMES = {
    "faces": "faces of the mesh",
    "degree": "degree of the surface",
    "contact": "contact model",
    "dt": "step dt",
    "integrator": "integrators",
    "lanes": "spacing of lanes",
    "rate": "frames a second",
    "method": "estimator",
    "tolerance": "tolerance",
    "chosen": "combinations",
}
"""Names of knobs for people."""
CHARACTER_WIDTH, LINE_HEIGHT = 0.55, 1.15
"""Mean width of a character and height of a line, relative to the font size (DejaVu Sans)."""
MARK = 4.0
"""Half the size, pt, of a point that has a name: names keep clear of it."""
ORDERED_KNOBS = {"faces", "degree", "dt", "lanes", "rate", "tolerance"}
"""Knobs with ordered levels: their points are joined."""
STATISTICAL_KNOBS = {"lanes", "rate", "method"}
"""Knobs that the numerical part does not depend on."""


def rows_by_knob(costs: Costs) -> dict[str, list[Row]]:
    """Measured settings of each knob; those of ordered knobs in order, with the scene's own."""
    out = {}
    for knob in KNOB_NAMES:
        rows = [row for row in costs.whole if row.knob == knob]
        if rows and knob in ORDERED_KNOBS:
            field = "lane_spacing" if knob == "lanes" else knob
            rows = sorted([*rows, costs.own], key=attrgetter(f"setting.{field}"))
        if rows:
            out[knob] = rows
    return out


@theme.styled
def work_precision(costs: Costs, targets: Sequence[float]) -> Figure:
    """Error over seconds of every setting with the Pareto front, and beside it the numerical part.

    targets, mm, are drawn as lines.
    """
    figure = theme.new_figure(9.6, 5.0)
    left, right = (theme.add_axes(figure, x, 1.1, 3.85, 3.5) for x in (0.75, 5.6))
    measured, own = rows_by_knob(costs), costs.own
    for k, (knob, rows) in enumerate(measured.items()):
        style: dict[str, Any] = {
            "marker": MARKERS[k % len(MARKERS)],
            "color": COLOURS[k % len(COLOURS)],
        }
        if knob == "chosen":
            style = {"marker": "o", "color": theme.INK, "mfc": "none", "mew": 1.3}
        seconds, line = [row.time for row in rows], "-" if knob in ORDERED_KNOBS else ""
        for axes, part in ((left, "total_mm"), (right, "numerical_mm")):
            if axes is left or knob not in STATISTICAL_KNOBS:
                values = [getattr(row, part) for row in rows]
                axes.plot(seconds, values, ls=line, lw=0.9, ms=5, label=KNOB_NAMES[knob], **style)
    for axes, value in ((left, own.total_mm), (right, own.numerical_mm)):
        axes.plot(
            own.time, value, "*", ms=12, color=theme.INK, label="the scene as it is", zorder=5
        )
        axes.set(xscale="log", yscale="log", xlabel="processor time (s): load, simulate, calibrate")
    x, y = ([getattr(row, key) for row in costs.front] for key in ("time", "total_mm"))
    left.step(x, y, where="post", color=theme.INK, lw=2.2, alpha=0.3, label="Pareto front")
    low, high = left.get_ylim()
    for target in targets:
        if low < target < high:
            left.axhline(target, color=theme.FAINT, lw=0.8, zorder=0)
    methods = measured.get("method", [])
    names = [row.setting.words(costs.base).replace("_", " ") for row in methods]
    label_points(left, [(row.time, row.total_mm) for row in methods], names, 7.0, theme.MUTED)
    left.set(ylabel="mean error of the taxels (mm)", title="Error with numerical part")
    right.set(ylabel="mean shift of the taxels (mm)", title="Numerical part, without noise")
    for axes in (left, right):
        decimal_ticks(axes)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=6, fontsize=8)
    return figure


def label_points(
    axes: Axes, points: ArrayLike, names: Sequence[str], size: float, color: str = theme.INK
) -> None:
    """Write names next to points (n, 2), in data coordinates, over no point and no other name where
    there is room.

    Names are on the right, or on the left, as near as there is room, with a line to their point:
    another one may be nearer. size: of the font.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patheffects import withStroke
    from matplotlib.transforms import Bbox

    data = np.asarray(points, dtype=float).reshape(-1, 2)
    places = axes.transData.transform(data) * 72.0 / axes.figure.dpi
    first, end = axes.bbox.x0 * 72.0 / axes.figure.dpi, axes.bbox.x1 * 72.0 / axes.figure.dpi
    height = LINE_HEIGHT * size
    taken = [Bbox.from_bounds(x - MARK, y - MARK, 2 * MARK, 2 * MARK) for x, y in places]
    rises = [5.0 + k * height for k in sorted(range(-len(data) - 2, len(data) + 1), key=abs)]
    for k in np.argsort(places[:, 1]):
        (x, y), width = places[k], CHARACTER_WIDTH * size * len(names[k])
        sides = [x + 6.0, x - 6.0 - width]
        room = [left for left in sides if first <= left <= end - width] or sides[:1]
        boxes = [Bbox.from_bounds(left, y + up, width, height) for up in rises for left in room]
        box = next((b for b in boxes if not b.count_overlaps(taken)), boxes[0])
        taken.append(box)
        inwards = box.x0 < x
        axes.annotate(
            names[k],
            tuple(data[k]),
            ((box.x1 if inwards else box.x0) - x, box.y0 - y),
            ha="right" if inwards else "left",
            textcoords="offset points",
            fontsize=size,
            color=color,
            zorder=6,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
        )
        end_of_name = (box.x1 if inwards else box.x0), box.y0 + 0.35 * size
        scale = axes.figure.dpi / 72.0
        led = axes.transData.inverted().transform(np.multiply([places[k], end_of_name], scale))
        axes.add_line(Line2D(*led.T, lw=0.6, color=theme.INK, zorder=5))


@theme.styled
def accuracy_time(
    points: Mapping[str, tuple[float, float]],
    stages: Mapping[str, float],
    bound: float | None = None,
) -> Figure:
    """Accuracy and time of one run: seconds and errors of estimators, and seconds of stages.

    points: method -> (seconds, mean error in mm); stages: name -> seconds; bound: Cramér-Rao
    bound on the mean error, mm.
    """
    figure = theme.new_figure(9.0, 3.4)
    left, right = (theme.add_axes(figure, x, 0.6, w, 2.4) for x, w in ((0.95, 4.4), (6.7, 2.0)))
    for k, (method, (x, y)) in enumerate(points.items()):
        left.plot(x, y, "o", color=theme.method_colour(method), ms=8 if k == 0 else 5)
    if bound is not None and np.isfinite(bound):
        left.axhline(bound, color=theme.INK, lw=1.0, ls="--")
        # in the middle: the fastest and the slowest estimator are often near the line
        left.annotate(f"Cramér-Rao bound {significant(bound)} mm", (0.5, bound), (0, -10),
                      xycoords=("axes fraction", "data"), textcoords="offset points", ha="center",
                      fontsize=8)  # fmt: skip
    left.set(xscale="log", yscale="log", xlabel="time of the estimate (s)")
    left.set(ylabel="mean error of the taxels (mm)", title="Estimators on this recording")
    left.margins(x=0.1, y=0.2)
    first, last = left.get_xlim()
    left.set_xlim(first, last * (last / first) ** 0.5)  # names are on the right
    decimal_ticks(left)
    label_points(left, list(points.values()), list(map(method_name, points)), 8.0)
    names = list(stages)[::-1]
    right.barh(names, [stages[name] for name in names], color=theme.ESTIMATE, height=0.6)
    right.tick_params(axis="y", length=0)
    right.set(xlabel="seconds", title="Time before the report")
    return figure


def decimal_ticks(axes: Axes) -> None:
    """Ticks of logarithmic axes as plain decimal numbers."""
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() != "log":
            continue
        span = high / low
        subs = (1.0,) if span > 100 else (1.0, 2.0, 5.0) if span > 8 else (1.0, 1.5, 2, 3, 4, 6)
        theme.log_ticks(axis, subs, numticks=12)


HEADER = ("target (mm)", "fastest setting", "seconds", "error (mm)", "numerical part (mm)")


def table(costs: Costs, targets: Sequence[float]) -> list[tuple[str, ...]]:
    """For each target, mm, the fastest measured setting that reaches it, as text."""
    rows: list[tuple[str, ...]] = []
    for target in targets:
        row = costs.cheapest(target)
        if row is None:
            best = min(costs.whole, key=lambda r: r.total_mm)
            said = f"none; best {significant(best.total_mm)}: {best.setting.words(costs.base)}"
            rows.append((f"{target:g}", said, "", "", ""))
        else:
            numbers = (f"{row.time:.2f}", significant(row.error_mm), significant(row.numerical_mm))
            rows.append((f"{target:g}", row.setting.words(costs.base), *numbers))
    return rows


def page(costs: Costs, targets: Sequence[float], png: Path, svg: Path) -> Content:
    """The page of `meshskin cost`."""
    own, best = costs.own, min(costs.whole, key=lambda r: r.total_mm)
    runs = f"{costs.seeds} seed{'s' * (costs.seeds != 1)} each"
    picture = SavedFigure(png, svg, "Error against processor time", CAPTION, "Work-precision plot")
    return Content(
        title=f"Accuracy and time: {costs.scene}",
        summary=f"The scene as it is: {significant(own.error_mm)} mm in {own.time:.2f} s of "
        f"processor time; {significant(own.numerical_mm)} mm of it by discretization.",
        tiles=[
            tile("The scene as it is", significant(own.error_mm), "mm", f"in {own.time:.2f} s"),
            tile(
                "Its numerical part", significant(own.numerical_mm), "mm", "by discretization alone"
            ),
            tile("Most accurate", significant(best.total_mm), "mm", f"in {best.time:.2f} s"),
            tile("Settings", str(len(costs.rows)), "", runs),
        ],
        sections={
            "Fastest settings for an accuracy": [
                markup.table(HEADER, table(costs, targets), numeric=(0, 2, 3, 4))
            ],
            "Work-precision diagram": [markup.saved_figure(picture)],
            "Accuracy of the reference": _routes(costs),
            "All settings": [_settings(costs)],
        },
    )


CAPTION = (
    "Left: mean error of the calibrated taxels with the noise of the scene and the numerical part "
    "(root of the sum of squares). Grey: the Pareto front. Right: mean shift of the taxels from "
    "the reference by mesh, contact model, step and tolerance alone."
)


def _routes(costs: Costs) -> list[str]:
    words = costs.reference.words(costs.base)
    line = f"The reference of the numerical parts is {words}. Other settings differ from it by:"
    rows = [(r.name, significant(r.mean_mm), significant(r.largest_mm)) for r in costs.routes]
    return [paragraphs(line), markup.table(("setting", "mean (mm)", "largest (mm)"), rows, (1, 2))]


def _settings(costs: Costs) -> str:
    header = ("knob", "change", "error (mm)", "bound (mm)", "numerical (mm)", "readings", "s", "")
    best = set(map(id, costs.front))
    body = []
    for row in costs.rows:
        note = row.failure or ("Pareto front" if id(row) in best else "")
        if not row.failure and row not in costs.whole:
            note = f"{row.located} taxels located"
        cells = (significant(v) for v in (row.error_mm, row.bound_mm, row.numerical_mm))
        readings = "" if row.failure else str(row.readings)
        seconds = "" if row.failure else f"{row.time:.3f}"
        said = row.setting.words(costs.base)
        body.append((KNOB_NAMES.get(row.knob, row.knob), said, *cells, readings, seconds, note))
    return markup.table(header, body, numeric=(2, 3, 4, 5, 6), collapsed="All measured settings")
