"""Style of all figures: palette, fonts, axes with fixed margins; saving; numbers as text.

Figures are matplotlib's `Figure` objects with an Agg canvas; pyplot and its global state are not
used, and matplotlib is imported when a figure is made.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from ..core import palette
from ..core.arrays import Array
from ..core.atomic_io import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Each colour has one meaning, in the figures of studies and notebooks, too.
INK, MUTED, FAINT = palette.INK, palette.MUTED, palette.FAINT
ESTIMATE, TRUTH, BOUND = palette.ESTIMATE, palette.TRUTH, palette.BOUND
WARNING, SEQUENTIAL, PALETTE = palette.WARNING, palette.SEQUENTIAL, palette.PALETTE
METHOD_COLOURS, method_colour = palette.METHOD_COLOURS, palette.method_colour

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "regular",
    "axes.titley": 1.0,  # where it is by default, but not measured in every draw
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "meshskin",
}
DPI = 150
"""Pixels per inch of PNG files: 900 to 1400 pixels of width."""
TICKS = 5
"""Most intervals between the ticks of a linear axis: enough to read a number to a tenth."""

P = ParamSpec("P")
R = TypeVar("R")


def styled(function: Callable[P, R]) -> Callable[P, R]:
    """Run `function` with the report's style; the caller's settings are restored."""

    @wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return function(*args, **kwargs)

    return inner


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of `width` x `height` inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DPI)


def add_axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes at a position in inches from the lower left corner.

    Margins are fixed because an automatic layout draws every figure twice. Ticks take most of the
    time of drawing, so that a linear axis has at most TICKS intervals.
    """
    w, h = figure.get_size_inches()
    axes = figure.add_axes((left / w, bottom / h, width / w, height / h))
    axes.locator_params(nbins=TICKS)
    return axes


def log_ticks(
    axis: Any, subs: Sequence[float] = (1.0,), numticks: int | None = None, minor: bool = True
) -> None:
    """Ticks of a logarithmic axis as plain numbers, at `subs` in each decade; minor: others, too,
    without numbers.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    axis.set_major_locator(LogLocator(subs=subs, numticks=numticks))
    axis.set_major_formatter(FuncFormatter(lambda x, _: compact(x).removeprefix("1 × ")))
    if minor:
        axis.set_minor_formatter(NullFormatter())
    else:
        axis.set_minor_locator(NullLocator())


def color_bar(figure: Figure, artist: Any, axes: Axes, label: str) -> Any:
    """A thin colour bar to the right of `axes`."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator, ScalarFormatter

    box = axes.get_position()
    w = figure.get_size_inches()[0]
    bar = figure.add_axes((box.x1 + 0.12 / w, box.y0, 0.12 / w, box.height))
    made = figure.colorbar(artist, cax=bar, label=label)
    if isinstance(made.formatter, ScalarFormatter):
        # a power of ten above the bar is overlooked, and zeros after the point are cut off
        made.locator = MaxNLocator(6, steps=[1, 2, 5, 10])
        made.formatter = FuncFormatter(lambda x, _: compact(x))
    bar.spines["outline"].set_visible(False)
    return made


@styled
def save(figure: Figure, folder: str | Path, name: str) -> tuple[Path, Path]:
    """Write folder/name.png and folder/name.svg, each atomically; return their paths.

    Raises OutputError if the folder cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png, svg = _paths(folder, name)
    axes = [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)]
    for axis in axes:
        if not axis.label.get_text():
            axis.set_label_coords(0.0, 0.0)  # placing a label measures all tick labels
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    _write_png(png, np.asarray(canvas.buffer_rgba()))
    for axis in axes:  # in the SVG, labels are where the PNG has them
        x, y = axis.label.get_transform().transform(axis.label.get_position())
        axis.set_label_coords(*axis.axes.transAxes.inverted().transform((x, y)))
    _write_svg(svg, figure)
    return png, svg


@styled
def save_panels(figure: Figure, folder: str | Path, names: Sequence[str]) -> tuple[Path, ...]:
    """Write the panels of a figure after `save`, each axes with its legend, as files of their own.

    The panels have equal widths and fill the figure; they are cut out of its PNG. Returns the
    paths. Raises OutputError if the folder cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    assert isinstance(figure.canvas, FigureCanvasAgg)  # of `save`
    pixels, paths = np.asarray(figure.canvas.buffer_rgba()), list[Path]()
    width, height = figure.get_size_inches() / (len(names), 1)
    for k, name in enumerate(names):
        png, svg = _paths(folder, name)
        paths += [png, svg]
        first, end = (round(edge * width * DPI) for edge in (k, k + 1))
        _write_png(png, pixels[:, first:end])
        for other, axes in enumerate(figure.axes):
            axes.set_visible(other == k)
        _write_svg(svg, figure, bbox_inches=Bbox.from_bounds(k * width, 0.0, width, height))
    return tuple(paths)


def _paths(folder: str | Path, name: str) -> tuple[Path, Path]:
    return Path(folder) / f"{name}.png", Path(folder) / f"{name}.svg"


def _write_png(path: Path, pixels: Array) -> None:
    """Write pixels (rows, columns, 4); they are opaque."""
    from PIL import Image

    opaque = np.ascontiguousarray(pixels[..., :3])
    with atomic(path) as temporary:
        Image.fromarray(opaque).save(temporary, "png", compress_level=1, dpi=(DPI, DPI))


def _write_svg(path: Path, figure: Figure, **part: Any) -> None:
    with atomic(path) as temporary:
        figure.savefig(temporary, format="svg", dpi=DPI, metadata={"Date": None}, **part)


UNGROUPED_DIGITS = 4
"""Digits of integers up to which no space separates the thousands."""


def grouped(value: float) -> str:
    """An integer with no-break spaces between the thousands."""
    return f"{value:,.0f}".replace(",", "\u00a0").replace("-", "−")


def compact(value: float | None, digits: int = 3) -> str:
    """A number with up to `digits` significant digits, without trailing zeros."""
    text = significant(value, digits)
    return re.sub(r"\.?0+(?= |$)", "", text) if "." in text else text


def significant(value: float | None, digits: int = 3) -> str:
    """A number with exactly `digits` significant digits, trailing zeros included.

    It is in decimal notation, or in scientific notation where that is long.
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if not 1e-4 <= abs(value) < 1e7:
        sign = "⁻" if exponent[0] == "-" else ""
        power = exponent[1:].lstrip("0").translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa} × 10{sign}{power}".replace("-", "−")
    if abs(value) >= 10 ** min(digits, UNGROUPED_DIGITS):
        return grouped(value)
    return f"{value:.{max(digits - 1 - int(exponent), 0)}f}".replace("-", "−")
