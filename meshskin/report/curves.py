"""Figures of the force over time and of error distributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..simulation.response import SETTLING_BAND
from . import theme
from .data import method_name
from .plane import MM, PAUSE
from .theme import compact, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


HIGHEST = 2.0
"""Force, in the reference, up to which the axis goes: peaks would hide the rest."""


def without_pauses(time: ArrayLike, values: ArrayLike) -> tuple[Array, Array]:
    """Times (m,) and values (m,) for a line, with NaN where time is missing between two of them."""
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    wait = np.diff(t)
    if not len(wait):
        return t, v
    at = np.flatnonzero(wait > PAUSE * np.median(wait)) + 1
    return np.insert(t, at, np.nan), np.insert(v, at, np.nan)


def draw_line(axes: Axes, time: Array, values: Array, **style: Any) -> None:
    """The line through (time, values), each (m,), interrupted where either is not finite."""
    good = np.isfinite(time) & np.isfinite(values)
    parts = np.split(np.arange(len(time)), np.flatnonzero(np.diff(good.astype(int))) + 1)
    lines = [envelope(time[k], values[k]) for k in parts if len(k) and good[k[0]]]
    gap = [np.nan]
    x, y = (
        np.concatenate([part for line in lines for part in (line[i], gap)] or [gap])
        for i in range(2)
    )
    axes.plot(x, y, **style)


def envelope(time: Array, values: Array, bins: int = 700) -> tuple[Array, Array]:
    """Minima and maxima of `bins` intervals of time: all that a plot of so many pixels shows."""
    if len(time) <= 2 * bins:
        return time, values
    edges = np.linspace(0, len(time), bins + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    return np.repeat(time[edges], 2), np.stack([low, high], axis=1).ravel()


@theme.styled
def force(
    time: ArrayLike,
    force: ArrayLike,
    reference: float | ArrayLike | None = None,
    settling: float = float("nan"),
    steady: ArrayLike | None = None,
) -> Figure:
    """Fig. 4: contact force and its reference: whole run, touch and settling, steady force.

    time (m,), s; force (m,), N, NaN where it is not controlled; reference: one value or (m,), N;
    settling: settling time after the first contact, s, NaN where it is not known;
    steady (m,): where the force is steady (by default from then on). The first touch and the steady
    force are those of the reference of the first touch.
    """
    t, f = np.asarray(time, dtype=float), np.asarray(force, dtype=float)
    ref = None if reference is None else np.broadcast_to(np.asarray(reference, float), t.shape)
    first = int(np.argmax(f > 0)) if np.any(f > 0) else 0
    touch = float(t[first]) if np.any(f > 0) else 0.0
    goal, highest = float("nan"), 0.0
    if ref is not None and len(ref):
        goal, highest = float(ref[first]), float(ref.max())
    window = max(4 * settling, 0.05) if np.isfinite(settling) else 0.5
    near = (t >= touch - 0.15 * window) & (t <= touch + window)
    held = t >= touch + (window if np.isfinite(settling) else 0.0)
    held &= np.isfinite(f) if steady is None else np.asarray(steady, dtype=bool)
    if ref is not None:
        held &= ref == goal
    figure = theme.new_figure(9.0, 3.2)
    whole, zoom, close = (theme.add_axes(figure, x, 0.55, 2.3, 2.1) for x in (0.6, 3.4, 6.6))
    every = np.ones(len(t), dtype=bool)
    for axes, x, chosen in ((whole, t, every), (zoom, (t - touch) * MM, near), (close, t, held)):
        draw_line(axes, *without_pauses(x[chosen], f[chosen]), color=theme.ESTIMATE, lw=1.0)
        if ref is not None and np.any(chosen):
            _draw_reference(axes, x[chosen], ref[chosen], band=axes is not close)
    peak = float(np.nanmax(f, initial=1e-9))
    top = 1.12 * max(min(peak, HIGHEST * highest) if highest else peak, highest)
    whole.set_ylim(0, top)
    zoom.set_ylim(0, 1.12 * max(float(np.nanmax(f[near], initial=1e-9)), np.nan_to_num(goal)))
    title = "Whole run" if peak <= top else f"Whole run, up to {compact(peak, 2)} N"
    whole.set(xlabel="time (s)", ylabel="normal force (N)", title=title)
    zoom.set(xlabel="time after touch (ms)", title="Touch and settling")
    zoom.set_xlim(-0.15 * window * MM, window * MM)
    _mark_settling(zoom, settling)
    _scale_to_reference(close, f[held], goal)
    _force_legend(figure, with_reference=np.isfinite(goal))
    return figure


def _draw_reference(axes: Axes, x: Array, reference: Array, band: bool) -> None:
    """Draw a reference (m,), N, that is constant over parts of x (m,), and its settling band."""
    ends = np.flatnonzero(np.diff(reference))
    rows = np.unique(np.concatenate([[0], ends, ends + 1, [len(x) - 1]]))
    x, reference = x[rows], reference[rows]
    axes.plot(x, reference, color=theme.WARNING, lw=0.9, ls="--")
    if band:
        low, high = reference * (1 - SETTLING_BAND), reference * (1 + SETTLING_BAND)
        axes.fill_between(x, low, high, color=theme.FAINT, lw=0)


@theme.styled
def recorded_force(time: ArrayLike, force: ArrayLike, references: Sequence[float] = ()) -> Figure:
    """The contact force (m,), N, at the times (m,), s, of a log, and its references, if any, N."""
    t, f = np.asarray(time, dtype=float), np.asarray(force, dtype=float)
    figure = theme.new_figure(9.0, 2.9)
    axes = theme.add_axes(figure, 0.6, 0.55, 8.2, 1.9)
    draw_line(axes, *without_pauses(t, f), color=theme.ESTIMATE, lw=1.0, marker=".", ms=1.5)
    for reference in references:
        axes.axhline(reference, color=theme.WARNING, lw=0.9, ls="--")
    axes.set_ylim(0, 1.12 * max(float(np.nanmax(f, initial=1e-9)), *references, 0.0))
    axes.set(xlabel="time (s)", ylabel="normal force (N)")
    _force_legend(figure, with_reference=bool(references), band=False)
    return figure


def _mark_settling(axes: Axes, settling: float) -> None:
    if not np.isfinite(settling):
        return
    axes.axvline(settling * MM, color=theme.MUTED, lw=0.8, ls=":")
    axes.annotate(
        f"within {100 * SETTLING_BAND:g} %\nafter {compact(settling * MM)} ms",
        (settling * MM, 0.1),
        (4, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
    )


def _scale_to_reference(axes: Axes, force: Array, goal: float) -> None:
    """Limits and title of the panel of the steady force."""
    axes.set(xlabel="time (s)", title="Steady force")
    axes.ticklabel_format(axis="y", useOffset=False)
    if np.isfinite(goal):
        off = float(np.max(np.abs(force - goal), initial=0.0))
        half = 1.3 * min(off, goal) or SETTLING_BAND * goal
        axes.set_ylim(max(goal - half, 0.0), goal + half)
        axes.set_title(f"Steady force, within {significant(off, 2)} N")


def _force_legend(figure: Figure, with_reference: bool, band: bool = True) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[object] = [Line2D([], [], color=theme.ESTIMATE, label="contact force")]
    if with_reference:
        handles.append(Line2D([], [], color=theme.WARNING, ls="--", label="reference"))
    if with_reference and band:
        handles.append(Patch(color=theme.FAINT, label=f"± {100 * SETTLING_BAND:g} %"))
    where = (0.5 / figure.get_size_inches()[0], 1.0)
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=where, ncols=len(handles))


@theme.styled
def errors(distances: Mapping[str, ArrayLike], bound: float | None = None) -> Figure:
    """Histograms of position errors, one row per method, on a common logarithmic axis.

    distances: method -> errors (n,), m, NaN where a method gives no estimate; bound: Cramér-Rao
    bound on the mean error, m. The rows are one axes, because axes take most of the time.
    """
    from matplotlib.ticker import MaxNLocator

    rows = {k: np.asarray(v, dtype=float).ravel() * MM for k, v in distances.items()}
    rows = {k: v[np.isfinite(v)] for k, v in rows.items()}
    low, high = _decades(np.concatenate([*rows.values(), [] if bound is None else [bound * MM]]))
    bins = np.geomspace(low, high, 8 * max(round(np.log10(high / low)), 1) + 1)
    counts = [np.histogram(np.clip(values, low, high), bins)[0] for values in rows.values()]
    step = 1.25 * float(np.max(counts, initial=0)) or 1.0
    bases = step * np.arange(len(rows))[::-1]
    figure = theme.new_figure(9.0, 0.85 + 1.1 * max(len(rows), 1))
    axes = theme.add_axes(figure, 2.6, 0.55, 6.2, 1.1 * max(len(rows), 1))
    for (name, values), count, base in zip(rows.items(), counts, bases, strict=True):
        axes.stairs(base + count, bins, baseline=base, fill=True, color=theme.method_colour(name))
        _name_row(axes, method_name(name), values, base + 0.45 * step)
    axes.hlines(bases[:-1], low, high, color=theme.MUTED, lw=0.7)
    ticks = [tick for tick in MaxNLocator(2, integer=True).tick_values(0, step) if tick < step]
    axes.set_yticks(
        np.add.outer(bases, ticks).ravel(), [compact(tick) for tick in ticks] * len(rows)
    )
    axes.set(ylim=(0, step * max(len(rows), 1)), xlabel="position error (mm)", ylabel="taxels")
    axes.set(xscale="log", xlim=(low, high))
    theme.log_ticks(axes.xaxis, numticks=9, minor=False)
    if bound is not None and np.isfinite(bound) and rows:
        _draw_bound(axes, bound * MM, on_right=bound * MM > low**0.4 * high**0.6)
    return figure


def _name_row(axes: Axes, name: str, errors: Array, middle: float) -> None:
    """Write the method's name and its mean error, mm, left of its histogram about `middle`."""
    mean = errors.mean() if len(errors) else float("nan")
    axes.text(
        -0.09,
        middle,
        f"{fill(name, 26)}\nmean {significant(mean)} mm",
        transform=axes.get_yaxis_transform(),
        ha="right",
        va="center",
        linespacing=1.5,
    )


def _draw_bound(axes: Axes, bound: float, on_right: bool) -> None:
    """A line at the bound, mm, with a label to its right or left."""
    axes.axvline(bound, color=theme.INK, lw=1.0, ls="--")
    axes.annotate(
        f"Cramér-Rao bound {significant(bound)} mm",
        (bound, 1.0),
        (-4 if on_right else 4, 3),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="right" if on_right else "left",
    )


def _decades(values: Array) -> tuple[float, float]:
    """Powers of ten around the positive values, at most eight decades below the largest."""
    x = values[np.isfinite(values) & (values > 0)]
    if not len(x):
        return 1e-3, 1.0
    high = 10.0 ** np.ceil(np.log10(x.max()) + 1e-9)
    low = 10.0 ** np.floor(np.log10(max(x.min(), high * 1e-8)))
    return float(low), float(max(high, 10 * low))
