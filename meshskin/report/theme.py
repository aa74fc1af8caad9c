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
from ..core.atomic_io import atomic, write_text

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
    from matplotlib.ticker import ScalarFormatter

    box = axes.get_position()
    w = figure.get_size_inches()[0]
    bar = figure.add_axes((box.x1 + 0.12 / w, box.y0, 0.12 / w, box.height))
    made = figure.colorbar(artist, cax=bar, label=label)
    if isinstance(made.formatter, ScalarFormatter):
        made.formatter.set_scientific(False)  # a power of ten above the bar is overlooked
    bar.spines["outline"].set_visible(False)
    return made


@styled
def save(
    figure: Figure, folder: str | Path, name: str, panels: Sequence[str] = ()
) -> tuple[Path, ...]:
    """Write folder/name.png and folder/name.svg, each atomically; return their paths.

    panels: names of further files, one for each axes of the figure with its legend; the axes have
    equal widths and fill it. Raises OutputError if the folder cannot be written.
    """
    from .renderer import draw

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.label.get_text():
                axis.set_label_coords(0.0, 0.0)  # placing a label measures all tick labels
    pixels, svg = draw(figure)
    parts = [(name, pixels, svg)]
    columns = zip(panels, np.array_split(pixels, len(panels) or 1, axis=1), strict=False)
    for k, (panel, part) in enumerate(columns):
        parts.append((panel, part, _panel(svg, k, len(panels))))
    paths = list[Path]()
    for stem, part, text in parts:
        paths += [Path(folder) / f"{stem}.png", Path(folder) / f"{stem}.svg"]
        _write_png(paths[-2], part)
        write_text(paths[-1], text)
    return tuple(paths)


def _panel(svg: str, k: int, count: int) -> str:
    """The k-th of `count` columns of an SVG of matplotlib, with the axes in it alone."""

    def definitions(other: re.Match[str]) -> str:
        """What other axes define may be used in this one."""
        return "".join(re.findall(r"^ *<defs>\n.*?^ *</defs>\n", other[0], re.M | re.S))

    def view(found: re.Match[str]) -> str:
        width = float(found[1]) / count
        return f'width="{width:g}pt" height="{found[2]}pt" viewBox="{k * width:g} 0 {width:g} '

    axes = rf'^  <g id="axes_(?!{k + 1}")\d+">\n.*?^  </g>\n'
    svg = re.sub(axes, definitions, svg, flags=re.M | re.S)
    return re.sub(r'width="(.*?)pt" height="(.*?)pt" viewBox="0 0 \S+ ', view, svg, count=1)


def _write_png(path: Path, pixels: Array) -> None:
    """Write pixels (rows, columns, 3)."""
    from PIL import Image

    with atomic(path) as temporary:
        image = Image.fromarray(np.ascontiguousarray(pixels))
        image.save(temporary, "png", compress_level=1, dpi=(DPI, DPI))


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
