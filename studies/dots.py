"""A figure of numbers by name: one row a name, one coloured dot for each kind of number.

Studies draw it: errors of several methods or beliefs in several cases, on one axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from meshskin.report import theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROW = 0.24
"""Height of a row, inches."""
LOGARITHMIC = 5.0
"""Ratio of the largest number to the least from which the axis is logarithmic."""
COLUMNS = 3
"""Columns of the legend."""
MARKS = "osD^vP*X"
"""Marks of the kinds, which tell them apart without colour, too."""


@theme.styled
def dots(
    rows: Mapping[str, Mapping[str, float | None]],
    label: str,
    *,
    limits: Mapping[str, float] | None = None,
    bands: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """rows: number by kind, by name of the row; what is None or not finite is left out.

    label: what the numbers are. limits: vertical lines, by what they are. bands: (low, high) by
    name of the row, drawn behind the dots.
    """
    names, kinds = list(rows), list(dict.fromkeys(kind for row in rows.values() for kind in row))
    height = ROW * len(names) + 0.1
    wide = 0.075 * max(map(len, names), default=10) + 0.3
    legend = 0.2 * -(-(len(kinds) + len(limits or {})) // COLUMNS)
    figure = theme.new_figure(wide + 5.4, height + 0.75 + legend)
    axes = theme.add_axes(figure, wide, 0.55, 5.2, height)
    for k, name in enumerate(names):
        axes.axhline(k, color=theme.FAINT, lw=0.6, zorder=0)
        if bands and name in bands:
            axes.plot(bands[name], (k, k), color=theme.FAINT, lw=6, solid_capstyle="butt", zorder=1)
    for j, kind in enumerate(kinds):
        at = [(row.get(kind), k) for k, row in enumerate(rows.values())]
        shown = np.array([(x, k) for x, k in at if x is not None and np.isfinite(x)]).reshape(-1, 2)
        colour = theme.METHOD_COLOURS.get(kind, theme.PALETTE[j % len(theme.PALETTE)])
        axes.plot(*shown.T, MARKS[j % len(MARKS)], color=colour, ms=4.5, label=kind, zorder=3)
    for words, value in (limits or {}).items():
        axes.axvline(value, color=theme.WARNING, lw=0.9, ls="--", label=words)
    values = np.array([x for row in rows.values() for x in row.values() if x is not None])
    values = values[np.isfinite(values)]
    if len(values) and 0 < LOGARITHMIC * values.min() < values.max():
        axes.set_xscale("log")
        theme.log_ticks(axes.xaxis, (1, 2, 5))
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=COLUMNS)
    return figure
