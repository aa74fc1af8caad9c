"""Small pictures of bodies, skins, contacts and tables, drawn by matplotlib.

Everything is drawn in orthographic projection into two-dimensional axes: the body as shaded
polygons, taxels and contacts as dots, dimmed where the body hides them. A picture of a large mesh
is one of a coarser mesh, so that every picture takes a fraction of a second. This module imports
matplotlib: import it where a picture is drawn.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .arrays import Array, means_by_group
from .palette import ESTIMATE, INK, PALETTE, SEQUENTIAL

MM = 1e3
"""Millimetres per metre."""
CELLS = 56
"""Cells along the longest side of a mesh whose vertices become one in a picture: 5 pixels each."""
MOST_FACES = 12_000
"""Faces above which a mesh is drawn coarser: 0.1 s of drawing."""
MOST_DOTS = 4000
"""Dots of one kind that are drawn, evenly chosen: a picture has room for no more."""
SIZE, SMALL = (6.4, 4.8), (3.0, 2.3)
"""Sizes, inches, of a picture and of that on a card."""
FONT, SMALL_FONT = 9.0, 6.5
"""Sizes of their texts, points."""
SMALL_POINTS = 100
"""Pixels of the page per inch of a picture on a card."""
DPI = 200
"""Pixels per inch of an image file: two for each pixel of the page."""
BODY = np.array([0.80, 0.82, 0.85])
"""Colour of a body that faces the light."""
LIGHT = np.array([0.35, 0.55, 0.76])
"""Direction to the light along the picture's right, up and towards the viewer (unit)."""
AMBIENT = 0.45
"""Brightness of a face along the light; one that faces it has 1."""
LEAST_RANGE = 0.02
"""Least range of a colour bar, relative to its end: smaller differences cannot be seen."""
OUTLYING = 3.0
"""Range of the values, relative to that of 98 % of them, from which a colour bar leaves out the
outermost 2 %, with arrows at its ends: a few values would take all colours."""
EDGED = 1000
"""Dots that have a white edge; more of them are a path, or too small."""
SURROUNDINGS = 0.4
"""Part of the mesh that a close view shows around the dots, relative to their extent."""
LEAST_DISC = 0.006
"""Least radius of a dot, relative to the extent of the picture: a pixel of a card."""
MOST_DISC, COVER = 0.02, 0.12
"""Largest radius of dots that have no size of their own, in the same unit, and that of one alone if
all together cover the same area."""
HIDDEN = 0.12
"""Opacity of a dot on the far side of the body."""
OBLIQUE = (0.45, -0.75, 0.48)
"""Direction to the viewer of a body without a front."""


class Picture(Figure):
    """A matplotlib figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self)


def png(figure: Figure) -> bytes:
    """The figure as the content of a PNG file."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def small_axes() -> Axes:
    """Axes of a picture on a card."""
    return _axes(SMALL)


def _axes(size: tuple[float, float]) -> Axes:
    with matplotlib.rc_context({"font.size": FONT if size == SIZE else SMALL_FONT}):
        return Picture(figsize=size, dpi=DPI, layout="constrained").add_subplot()


def _is_small(ax: Axes | None) -> bool:
    return ax is not None and _figure(ax).get_figwidth() <= SMALL[0]


def _figure(ax: Axes) -> Figure:
    """The figure that axes are in."""
    found = ax.get_figure(root=True)
    assert found is not None
    return found


@contextmanager
def _drawn(ax: Axes | None) -> Iterator[Axes]:
    """The axes that are drawn into, those of a new figure for None, with the size of their text."""
    with matplotlib.rc_context({"font.size": SMALL_FONT if _is_small(ax) else FONT}):
        yield _axes(SIZE) if ax is None else ax


@dataclass(frozen=True)
class View:
    """An orthographic view: rows right, up and towards the viewer (3, 3), body frame."""

    axes: Array

    @classmethod
    def along(cls, toward: Array | Sequence[float]) -> View:
        """The view from a direction (3,); up is nearest to z, or to y where z is the direction."""
        t = np.asarray(toward, dtype=float)
        t = t / np.linalg.norm(t)
        up = np.array([0.0, 0.0, 1.0] if abs(t[2]) < 0.95 else [0.0, 1.0, 0.0])
        up = up - (up @ t) * t
        up /= np.linalg.norm(up)
        return cls(np.stack([np.cross(up, t), up, t]))

    def flat(self, points: Array) -> Array:
        """Coordinates (..., 2), mm, of points (..., 3), m."""
        return np.asarray(points @ self.axes[:2].T * MM)


def front(normals: Array) -> Array:
    """The direction (3,) from which most of a skin is seen; oblique where it is all round."""
    finite = normals[np.isfinite(normals).all(axis=1)]
    mean = finite.mean(axis=0) if len(finite) else np.zeros(3)
    if np.linalg.norm(mean) < 0.1:
        return np.array(OBLIQUE)
    # tilted, so that the shape of the body shows
    return np.asarray(mean / np.linalg.norm(mean) + 0.35 * np.array(OBLIQUE))


def coarser(vertices: Array, faces: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """A mesh of at most some thousand faces for a picture: vertices in one cell become their mean.

    Vertices (v, 3), faces (k, 3); small meshes are returned as they are.
    """
    if len(faces) <= MOST_FACES:
        return vertices, faces
    low, extent = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    cell = ((vertices - low) * (CELLS / extent)).astype(np.int64)
    key = (cell[:, 0] * (CELLS + 1) + cell[:, 1]) * (CELLS + 1) + cell[:, 2]
    _, group = np.unique(key, return_inverse=True)
    corners = group[faces]
    a, b, c = corners.T
    return means_by_group(vertices, group), corners[(a != b) & (b != c) & (c != a)]


def _draw_body(ax: Axes, view: View, vertices: Array, faces: NDArray[np.intp]) -> None:
    """The faces from the farthest to the nearest, shaded on both sides."""
    at, triangles = coarser(np.asarray(vertices), np.asarray(faces))
    corners = at[triangles] @ view.axes.T
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    corners, normal = corners[length > 0], normal[length > 0] / length[length > 0, None]
    normal *= np.where(normal[:, 2:] < 0, -1.0, 1.0)
    shade = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LIGHT, 0.0, 1.0)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    polygons = PolyCollection(
        corners[order, :, :2] * MM, facecolors=shade[order, None] * BODY, edgecolors="none",
        antialiaseds=False, rasterized=True, zorder=1,
    )  # fmt: skip
    ax.add_collection(polygons, autolim=False)


def _draw_dots(
    ax: Axes,
    view: View,
    points: Array,
    normals: Array | None,
    values: Array | None,
    label: str,
    radius: float,
) -> None:
    """Discs of a radius, m, at points (n, 3), m, the hidden ones dimmed, coloured by values (n,)
    with a colour bar."""
    good = np.isfinite(points).all(axis=1)
    if values is not None:
        good &= np.isfinite(values)
    rows = np.flatnonzero(good)
    if not len(rows):
        return
    rows = rows[:: -(-len(rows) // MOST_DOTS)]
    xy = view.flat(points[rows])
    shown = np.ones(len(rows)) if normals is None else normals[rows] @ view.axes[2]
    alpha = np.where(shown >= -1e-9, 1.0, HIDDEN)
    wide = np.full(len(rows), 2.0 * MM * radius)
    style: dict[str, Any] = {"linewidths": 0.0, "zorder": 3, "facecolors": ESTIMATE}
    if values is not None and len(rows) <= EDGED:  # on a body, grey values would not stand out
        style |= {"linewidths": 0.4, "edgecolors": "white"}
    dots = EllipseCollection(
        wide, wide, np.zeros(len(rows)), units="xy", offsets=xy, offset_transform=ax.transData,
        cmap=SEQUENTIAL, **style,
    )  # fmt: skip
    dots.set_alpha(alpha.tolist())
    ax.add_collection(dots, autolim=False)
    if values is None:
        return
    chosen = values[rows]
    low, high = float(chosen.min()), float(chosen.max())
    bulk = np.percentile(chosen, (1, 99))
    if high - low > OUTLYING * np.ptp(bulk):
        low, high = bulk
    lacking = max(LEAST_RANGE * high - (high - low), 0.0) / 2
    low, high = low - lacking, high + lacking
    dots.set_array(chosen)
    dots.set_clim(low, high)
    beyond = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    extend = beyond[int(chosen.min() < low), int(chosen.max() > high)]
    bar = _figure(ax).colorbar(
        ScalarMappable(dots.norm, SEQUENTIAL), ax=ax, label=label, shrink=0.8, extend=extend
    )
    bar.formatter.set_useOffset(False)  # type: ignore[attr-defined]


def _scale_bar(ax: Axes, low: Array, high: Array) -> None:
    """A bar of a round length, and its length in mm."""
    span = float(high[0] - low[0])
    decade = 10.0 ** np.floor(np.log10(max(span / 3.0, 1e-9)))
    length = max(decade * k for k in (1, 2, 5) if decade * k <= span / 3.0 * (1 + 1e-9))
    x, y = low[0], low[1] - 0.07 * (high[1] - low[1] or 1.0)
    ax.plot([x, x + length], [y, y], color=INK, lw=1.5, solid_capstyle="butt", clip_on=False)
    ax.annotate(f"{length:g} mm", (x + length, y), (4, 0), textcoords="offset points", va="center")


def solid(
    ax: Axes | None,
    *,
    toward: Array | Sequence[float] = OBLIQUE,
    mesh: Any = None,
    points: Array | None = None,
    normals: Array | None = None,
    values: Array | None = None,
    label: str = "",
    radius: float = 0.0,
    close: bool = False,
    title: str = "",
) -> Figure:
    """Draw a mesh (.vertices, .faces) and dots seen from `toward`; the figure.

    ax: matplotlib axes; None: those of a new figure. points, normals (n, 3), m; values (n,), by
    which the dots are coloured, `label` what they are; radius of the dots, m; close: show what is
    near the dots, and not the whole mesh.
    """
    with _drawn(ax) as ax:
        view, seen = View.along(toward), [np.zeros((0, 2))]
        if mesh is not None:
            _draw_body(ax, view, mesh.vertices, mesh.faces)
            seen.append(view.flat(np.asarray(mesh.vertices)))
        if points is not None:
            at = view.flat(points[np.isfinite(points).all(axis=1)])
            every = np.concatenate([*seen, at])
            extent = float(np.ptp(every, axis=0).max()) / MM if len(every) else 0.0
            free = COVER / max(len(at), 1) ** 0.5 if not radius else 0.0
            disc = max(radius, min(max(free, LEAST_DISC), MOST_DISC) * extent)
            _draw_dots(ax, view, points, normals, values, label, disc)
            seen += [at - MM * disc, at + MM * disc]
        every = np.concatenate(seen)
        ax.set_aspect("equal")
        ax.set_axis_off()
        if len(every):
            low, high = every.min(axis=0), every.max(axis=0)
            if close and points is not None and len(at):
                near = np.concatenate(seen[-2:])
                around = SURROUNDINGS * float(np.ptp(near, axis=0).max())
                low = np.maximum(low, near.min(axis=0) - around)
                high = np.minimum(high, near.max(axis=0) + around)
            margin = 0.04 * float((high - low).max() or 1.0)
            ax.set(xlim=(low[0] - margin, high[0] + margin))
            ax.set(ylim=(low[1] - 4 * margin, high[1] + margin))
            _scale_bar(ax, low, high)
        if title and not _is_small(ax):
            ax.set_title(title, loc="left")
        return _figure(ax)


def bars(
    ax: Axes | None, names: Sequence[str], values: Sequence[float], label: str, on: Sequence[bool]
) -> Figure:
    """Draw horizontal bars on a logarithmic axis, the first on top; those not `on` are grey."""
    with _drawn(ax) as ax:
        rows = np.arange(len(names))
        ax.barh(rows, values, color=[ESTIMATE if one else "#b6bcc4" for one in on])
        ax.set_yticks(rows, names)
        ax.invert_yaxis()
        if any(value > 0 for value in values):
            ax.set_xscale("log")
        ax.set_xlabel(label)
        ax.spines[["top", "right"]].set_visible(False)
        return _figure(ax)


def curves(
    ax: Axes | None,
    rows: Iterable[tuple[str, Sequence[Any], Sequence[Sequence[float]]]],
    x: str,
    y: str,
    colors: Mapping[str, str] | None = None,
) -> Figure:
    """Draw one line a row (label, x values, y values of each): means, and all values as faint dots.

    Texts of x become categories. colors: of labels; others have those of PALETTE in turn.
    """
    with _drawn(ax) as ax:
        for k, (label, across, values) in enumerate(rows):
            color = (colors or {}).get(label, PALETTE[k % len(PALETTE)])
            means = [float(np.mean(each)) for each in values]
            ax.plot(across, means, "o-", ms=3, lw=1, color=color, label=label)
            where = [at for at, each in zip(across, values, strict=True) for _ in each]
            single = [value for each in values for value in each]
            ax.scatter(where, single, s=14, lw=0, alpha=0.3, color=color)
        ax.set(xlabel=x, ylabel=y)
        ax.spines[["top", "right"]].set_visible(False)
        handles, labels = ax.get_legend_handles_labels()
        if any(labels):
            ax.legend(handles, labels, frameon=False)
        return _figure(ax)
