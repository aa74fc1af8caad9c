"""Maps of the skin on its tangent plane: estimates, iterations, coverage, sigma, residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from . import theme
from .data import Iterations, ReportData
from .plane import MM, Plane, drawn_scale, finite_rows, path_with_breaks, pitch
from .theme import grouped, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SATURATION = 3.0
"""Standard deviation, in the median one, from which all have one colour."""
LARGE = 2.0
"""Residuals, in the median taxel's, up to which a colour scale goes at least: by chance those of 20
readings are within a third of it."""
RASTERIZE_ABOVE = 500
"""Marks above which a figure's marks are rasterized: each takes 1 kB of SVG."""


def _map_axes(figure: Figure, xy: Array, left: float, bottom: float, size: float) -> Axes:
    """Square axes of one scale around points (n, 2), mm."""
    axes = theme.add_axes(figure, left, bottom, size, size)
    p = finite_rows(xy)
    centre = (p.min(axis=0) + p.max(axis=0)) / 2 if len(p) else np.zeros(2)
    half = 0.55 * float(np.max(np.ptp(p, axis=0), initial=0.0)) if len(p) else 0.0
    half = half or 1.0
    axes.set(xlim=centre[0] + np.array([-half, half]), ylim=centre[1] + np.array([-half, half]))
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("along the skin, first axis (mm)")
    axes.set_ylabel("second axis (mm)")
    return axes


def _discs(xy: Array, data: ReportData) -> Array:
    """Corners (2 n, 2), mm, of the discs of taxels at points (n, 2), mm."""
    radius = data.disc_radius * MM
    return np.concatenate([xy - radius, xy + radius])


def _ellipses(
    axes: Axes, xy: Array, diameters: ArrayLike, heading: Array | float = 0.0, **style: Any
) -> Any:
    """Ellipses of `diameters` (n, 2) or one, mm, and `heading` (degrees) at points (n, 2), mm."""
    from matplotlib.collections import EllipseCollection

    width, height = np.broadcast_to(diameters, xy.shape).T
    ellipses = EllipseCollection(
        width,
        height,
        np.broadcast_to(heading, len(xy)),
        units="xy",
        offsets=xy,
        offset_transform=axes.transData,
        rasterized=len(xy) > RASTERIZE_ABOVE,
        **style,
    )
    axes.add_collection(ellipses, autolim=False)
    return ellipses


def _segments(axes: Axes, start: Array, end: Array, **style: Any) -> None:
    from matplotlib.collections import LineCollection

    lines = LineCollection(
        list(np.stack([start, end], axis=1)),
        rasterized=len(start) > RASTERIZE_ABOVE,
        capstyle="round",
        **style,
    )
    axes.add_collection(lines, autolim=False)


def _legend(axes: Axes, handles: list[Any], above: float = 0.0) -> None:
    """A line of entries over the axes, `above` of their height higher, over a title."""
    axes.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(-0.02, 1.0 + above),
        ncols=len(handles),
        borderaxespad=0.3,
        handletextpad=0.5,
        columnspacing=1.4,
        handlelength=1.4,
    )


def _handle(label: str, **style: Any) -> Any:
    """A legend entry."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


DOT: dict[str, Any] = {"ls": "", "marker": "o"}
CROSS: dict[str, Any] = {"ls": "", "marker": "x", "color": theme.WARNING}


@theme.styled
def estimates(data: ReportData) -> Figure:
    """Fig. 5: true discs and estimated centres on the tangent plane, with enlarged errors.

    The disc of a taxel without an estimate is crossed out.
    """
    t, plane = data.display_positions, data.plane
    a, b = plane.project(t), plane.project(data.calibration.positions)
    seen = np.isfinite(b).all(axis=1)
    lengths = np.linalg.norm(b - a, axis=1)
    factor, short = drawn_scale(lengths, 0.4 * pitch(t) * MM)
    ends = a + (factor * short)[:, None] * (b - a)
    figure = theme.new_figure(6.0, 6.1)
    axes = _map_axes(figure, np.concatenate([_discs(a, data), ends]), 0.65, 0.6, 5.0)
    _ellipses(
        axes,
        a,
        2 * data.disc_radius * MM,
        facecolors="none",
        edgecolors=theme.TRUTH,
        linewidths=0.8,
    )
    cut = seen & (short < 1.0)
    _segments(axes, a[seen & ~cut], ends[seen & ~cut], color=theme.WARNING, lw=1.3)
    _segments(axes, a[cut], ends[cut], color=theme.WARNING, lw=1.3, ls=":")
    axes.plot(*b[seen].T, "o", ms=2.6, color=theme.ESTIMATE, rasterized=len(b) > RASTERIZE_ABOVE)
    axes.plot(*a[~seen].T, "x", ms=7, color=theme.WARNING)
    handles = [
        _handle("true disc", **DOT, mfc="none", mec=theme.TRUTH, ms=8),
        _handle("estimate", **DOT, color=theme.ESTIMATE, ms=3),
        _handle(f"error × {grouped(factor)}", color=theme.WARNING),
    ]
    if cut.any():
        handles.append(_handle(f"{cut.sum()} cut short", color=theme.WARNING, ls=":"))
    if not seen.all():
        handles.append(_handle("no estimate", **CROSS))
    _legend(axes, handles)
    return figure


def _view_points(skin: Array, more: Array, beyond: float) -> Array:
    """Points (n, 2) that a map contains: the skin, and `more` up to `beyond` of its extent away."""
    low, high = skin.min(axis=0), skin.max(axis=0)
    reach = beyond * max(float(np.max(high - low)), 1e-9)
    return np.concatenate([skin, np.clip(more, low - reach, high + reach)])


def _iteration_panel(axes: Axes, truth: Array, estimate: Array, title: str, goal: str) -> None:
    good = np.isfinite(estimate).all(axis=1) & np.isfinite(truth).all(axis=1)
    a, b = truth[good], estimate[good]
    _segments(axes, a, b, color=theme.FAINT, lw=0.7)
    many = len(a) > RASTERIZE_ABOVE
    axes.plot(*a.T, "o", ms=4.5, mfc="none", mec=theme.TRUTH, mew=0.8, rasterized=many)
    axes.plot(*b.T, "o", ms=2.6, color=theme.ESTIMATE, rasterized=many)
    axes.set_title(title)
    axes.set_xlabel("first axis (mm)")
    handles = [
        _handle(goal, **DOT, mfc="none", mec=theme.TRUTH, ms=5),
        _handle("estimate", **DOT, color=theme.ESTIMATE, ms=3.5),
        _handle("difference", color=theme.FAINT),
    ]
    _legend(axes, handles, above=0.1)


def representative_iterations(iterates: Array) -> tuple[int, int, int]:
    """Index of the first of iterates (k, n, 3), of the one nearest to half way, and of the last."""
    last = len(iterates) - 1
    if last < 2:
        return 0, 0, last
    left = np.nanmean(np.linalg.norm(iterates - iterates[-1], axis=2), axis=1)
    return 0, 1 + int(np.argmin(np.abs(left[1:last] - left[0] / 2))), last


@theme.styled
def iterations(run: Iterations, plane: Plane) -> Figure:
    """Fig. 6-8: pose-graph estimates at the first, a middle and the last iteration.

    The middle one is nearest to half way between the first and the last. Three panels of equal
    width, each with its legend, for `theme.save_panels`.
    """
    t, all_iterates = np.asarray(run.reference), np.asarray(run.positions)
    chosen = representative_iterations(all_iterates)
    flat = [plane.project(all_iterates[k]) for k in chosen]
    a = plane.project(t)
    view = _view_points(finite_rows(a), finite_rows(np.concatenate(flat)), 0.75)
    goal = "true taxel" if run.has_truth else "last iterate"
    size, width = 2.75, 3.5
    figure = theme.new_figure(width * len(chosen), size + 1.25)
    for column, (k, estimate) in enumerate(zip(chosen, flat, strict=True)):
        axes = _map_axes(figure, view, 0.65 + width * column, 0.55, size)
        error = np.linalg.norm(all_iterates[k] - t, axis=1)
        mean = float(np.nanmean(error)) * MM if np.isfinite(error).any() else float("nan")
        title = f"Iteration {k}: mean {significant(mean)} mm off"
        _iteration_panel(axes, a, estimate, title, goal)
    return figure


@theme.styled
def coverage(data: ReportData) -> Figure:
    """How many readings each taxel gave, over the path of the contact; untouched ones crossed.

    Untouched taxels are not drawn where there is no truth that tells where they are.
    """
    from matplotlib.colors import LogNorm

    counts, plane = np.asarray(data.calibration.readings, dtype=float), data.plane
    xy, diameter = plane.project(data.display_positions), 2 * data.disc_radius * MM
    drawn = np.isfinite(xy).all(axis=1)
    touched = (counts > 0) & drawn
    figure = theme.new_figure(6.6, 6.1)
    route = plane.project(np.zeros((0, 3)) if data.recording is None else data.recording.points)
    view = _view_points(_discs(xy[drawn], data), route, 0.2) if drawn.any() else route
    axes = _map_axes(figure, view, 0.65, 0.6, 5.0)
    handles = []
    if len(route):
        assert data.recording is not None
        line, _ = path_with_breaks(data.recording.points, data.recording.time)
        style: dict[str, Any] = {"color": theme.MUTED, "alpha": 0.7, "zorder": 3}
        axes.plot(*plane.project(line).T, lw=0.5, **style)
        many = len(line) > RASTERIZE_ABOVE
        axes.plot(*plane.project(line).T, ".", ms=1.0, rasterized=many, **style)
        handles.append(_handle("path of the contact", color=theme.MUTED, lw=0.8))
    discs = _ellipses(axes, xy[touched], diameter, cmap=theme.SEQUENTIAL, linewidths=0)
    discs.set_array(counts[touched])
    least, most = (counts[touched].min(), counts[touched].max()) if touched.any() else (1.0, 1.0)
    discs.set_norm(LogNorm(least, max(most, 2 * least)))
    bar = theme.color_bar(figure, discs, axes, "readings of the taxel")
    # less than a decade of 1, 2, 5 may have one tick: even steps then
    even = () if most > 5 * least else np.unique(np.linspace(least, most, 5).round())
    theme.log_ticks(bar.ax.yaxis, (1, 2, 5), minor=False)
    if len(even):
        bar.set_ticks(even)
    missed = ~touched & drawn
    if missed.any():
        _ellipses(axes, xy[missed], diameter, facecolors="white", edgecolors=theme.WARNING)
        axes.plot(*xy[missed].T, "x", ms=6, color=theme.WARNING)
        handles.append(_handle("never touched", **CROSS))
    _legend(axes, handles)
    return figure


def ellipse_axes(covariances: ArrayLike) -> tuple[Array, Array]:
    """1-sigma semi-axes (n, 2), larger first, and heading (n,) in degrees of (n, 2, 2)."""
    c = np.asarray(covariances, dtype=float)
    good = np.isfinite(c).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(good[:, None, None], c, 0.0))
    sigma = np.sqrt(np.maximum(values[:, ::-1], 0.0))
    sigma[~good] = np.nan
    return sigma, np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))


@theme.styled
def uncertainty(data: ReportData) -> Figure:
    """The stated 1-sigma ellipse of each taxel's position, enlarged, with its size as colour."""
    p, plane = data.calibration.positions, data.plane
    xy = plane.project(p)
    sigma, heading = ellipse_axes(plane.project_covariance(data.covariances))
    good = np.isfinite(xy).all(axis=1) & np.isfinite(sigma).all(axis=1)
    xy, sigma, heading = xy[good], sigma[good], heading[good]
    factor, short = drawn_scale(sigma[:, 0], 0.35 * pitch(p) * MM)
    reach = (factor * short * sigma[:, 0])[:, None]
    figure = theme.new_figure(7.2, 6.1)
    axes = _map_axes(figure, np.concatenate([xy - reach, xy + reach]), 0.65, 0.6, 5.0)
    edges = np.where(short < 1.0, theme.WARNING, "none")
    style: dict[str, Any] = {
        "cmap": theme.SEQUENTIAL,
        "linewidths": 1.2,
        "edgecolors": edges.tolist(),
    }
    ellipses = _ellipses(axes, xy, 2 * (factor * short)[:, None] * sigma, heading, **style)
    ellipses.set_array(sigma[:, 0])
    # a few large ones would make all others look alike
    largest, median = float(np.max(sigma, initial=1e-12)), float(np.median([*sigma[:, 0], 1e-12]))
    ellipses.set_clim(0, min(largest, max(SATURATION * median, 1e-12)))
    beyond = "" if largest <= SATURATION * median else f"; up to {significant(largest)}"
    theme.color_bar(figure, ellipses, axes, f"largest 1-sigma along the skin (mm){beyond}")
    label = f"1 sigma along the skin × {grouped(factor)}"
    handles = [_handle(label, **DOT, color=theme.MUTED, ms=7)]
    if cut := int(np.sum(short < 1.0)):
        handles.append(_handle(f"{cut} drawn smaller", **DOT, mfc="none", mec=theme.WARNING, ms=7))
    _legend(axes, handles)
    return figure


def residual_scale(r: Array) -> float:
    """End of the colour scale of residuals (n,), in the median taxel's."""
    return min(float(np.max(r[np.isfinite(r)], initial=LARGE)), SATURATION)


@theme.styled
def residuals(data: ReportData) -> Figure:
    """How large the residuals of each taxel are, and beside it, where contacts were held out, how
    far from their places the readings put them, enlarged."""
    validation, plane, r = data.validation, data.plane, data.residuals
    xy, drawn = plane.project(data.display_positions), np.isfinite(r)
    view = _discs(xy[drawn], data)
    figure = theme.new_figure(6.6 if validation is None else 13.0, 6.3)
    axes = _map_axes(figure, view, 0.65, 0.6, 5.0)
    faulty = np.zeros(data.count, dtype=bool)
    if data.calibration.faults is not None:
        faulty = data.calibration.faults != ""
    edges = np.where(faulty, theme.WARNING, "none")[drawn].tolist()
    discs = _ellipses(
        axes, xy[drawn], 2 * data.disc_radius * MM, cmap=theme.SEQUENTIAL, edgecolors=edges,
        linewidths=1.5,
    )  # fmt: skip
    discs.set_array(r[drawn])
    discs.set_clim(0.0, residual_scale(r))
    largest = float(np.max(r[drawn], initial=0.0))
    beyond = "" if largest <= SATURATION else f"; up to {significant(largest)}"
    theme.color_bar(figure, discs, axes, f"rms residual over the median taxel's{beyond}")
    axes.set_title("Residuals of the taxels")
    if (faulty & drawn).any():
        _legend(axes, [_handle("fault", **DOT, mfc="none", mec=theme.WARNING, ms=8)], above=0.06)
    if validation is not None:
        where, put = plane.project(validation.points), plane.project(validation.localized)
        good = np.isfinite(put).all(axis=1)
        where, off = where[good], (put - where)[good]
        length = np.linalg.norm(off, axis=1)
        factor, short = drawn_scale(length, 0.35 * pitch(data.display_positions) * MM)
        axes = _map_axes(figure, np.concatenate([view, where]), 7.25, 0.6, 5.0)
        _ellipses(
            axes, xy[drawn], 2 * data.disc_radius * MM, facecolors="none", edgecolors=theme.FAINT
        )
        _segments(axes, where, where + (factor * short)[:, None] * off, color=theme.ESTIMATE, lw=1)
        axes.plot(*where.T, ".", ms=2, color=theme.INK, rasterized=len(where) > RASTERIZE_ABOVE)
        axes.set_title("Held-out contacts")
        label = f"to where their readings put them × {grouped(factor)}"
        handles = [_handle("contact points", ls="", marker=".", color=theme.INK)]
        _legend(axes, [*handles, _handle(label, color=theme.ESTIMATE)], above=0.06)
    return figure
