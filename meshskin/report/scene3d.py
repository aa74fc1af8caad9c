"""The 3D view: a plotly figure as plain JSON, without plotly's (slow) Python objects.

Arrays are base64 of single precision numbers in mm, which plotly.js decodes.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..geometry.body import Body
from ..geometry.primitives import Capsule
from ..geometry.surface.fans import vertex_normals
from ..recording.recording import Recording
from . import maps, markup, theme
from .data import ReportData
from .decimation import decimate
from .plane import MM, drawn_scale, finite_rows, path_with_breaks, pitch, tangent_plane
from .theme import compact, grouped, significant

MAX_FACES = 5000
"""Most faces of the body in the page: 0.1 MB."""
SUNK = 1e-3
"""Depth of the contacts below the body, m, from which it hides them."""
FIELD_OF_VIEW = 0.29
"""Tangent of half the angle that the axes take of the height of the view: 0.7 of what plotly's
camera sees, so that their numbers and titles are in view."""
LOWERED = 0.04
"""How far below the middle the camera looks, in its distance: the titles of the axes are below.
Chosen by looking at a flat body, whose titles were cut."""
TICKS, FEWEST_TICKS = 6, 3
"""Most numbers at an axis, as long as the view or as short as it may be; more would overlap."""
WIDTH = 1.6
"""Width of the view in its height, at least."""
FRAME_LENGTH = 0.4
"""Length of the axes of drawn frames, relative to the distance between taxels."""
LIGHT = {"x": 0.6, "y": -1.2, "z": 1.0003}
"""Light from behind the viewer's left shoulder. plotly takes the position in clip coordinates (its
camera sees from 0.01 to 1,000 of the size of the axes): beyond infinity, at 1.00002, is behind the
viewer, where right and up are reversed."""
_COLOURS = (("x", "#d62728"), ("y", "#2ca02c"), ("z", "#1f77b4"))
_MAX_FRAMES = 400
"""Most taxels with a frame and an ellipsoid; of larger skins every k-th has them."""


def _packed(values: ArrayLike, kind: str = "f4") -> dict[str, str]:
    data = np.ascontiguousarray(np.asarray(values), dtype=f"<{kind}")
    return {"dtype": kind, "bdata": base64.b64encode(data.tobytes()).decode()}


def _xyz(points: Array) -> dict[str, Any]:
    return {axis: _packed(points[:, k] * MM) for k, (axis, _) in enumerate(_COLOURS)}


def _mesh(vertices: Array, faces: ArrayLike) -> dict[str, Any]:
    f = np.asarray(faces)
    return {"type": "mesh3d", "lightposition": LIGHT, **_xyz(vertices)} | {
        k: _packed(f[:, c], "i4") for c, k in enumerate("ijk")
    }


def _scatter(name: str, points: Array, mode: str, **style: Any) -> dict[str, Any]:
    return {"type": "scatter3d", "mode": mode, "name": name, **_xyz(points), **style}


def _markers(name: str, points: Array, texts: list[str], **marker: Any) -> dict[str, Any]:
    return _scatter(name, points, "markers", marker=marker, text=texts, hoverinfo="text")


def body(
    vertices: ArrayLike, faces: ArrayLike, focus: ArrayLike, inward: float, transparent: bool
) -> dict[str, Any]:
    """The body, moved `inward` (m) along its normals so that points on it are visible."""
    v, f = decimate(vertices, faces, focus, MAX_FACES)
    return _mesh(v - inward * vertex_normals(v, f), f) | {
        "name": f"body (drawn {compact(inward * MM, 2)} mm inward)",
        "color": "#d9dce1",
        "lighting": {"ambient": 0.62, "diffuse": 0.5, "specular": 0.04, "roughness": 0.9},
        "opacity": 0.4 if transparent else 1.0,
        "hoverinfo": "skip",
        "showlegend": True,
    }


def frames(poses: Array, length: float, name: str, visible: bool = True) -> list[dict[str, Any]]:
    """Red, green and blue axes of poses (n, 4, 4), with one legend entry."""
    good = poses[np.isfinite(poses).all(axis=(1, 2))]
    good = good[:: -(-len(good) // _MAX_FRAMES) or 1]
    at = good[:, :3, 3]
    gap = np.full_like(at, np.nan)  # between separate lines
    return [
        _scatter(
            name,
            np.stack([at, at + length * good[:, :3, k], gap], axis=1).reshape(-1, 3),
            "lines",
            legendgroup=name,
            showlegend=k == 0,
            hoverinfo="skip",
            visible=True if visible else "legendonly",
            line={"color": colour, "width": 3},
        )
        for k, (_, colour) in enumerate(_COLOURS)
    ]


def ellipsoids(positions: Array, covariances: Array, wanted: float) -> dict[str, Any] | None:
    """1-sigma ellipsoids, enlarged until the median one's largest semi-axis is near `wanted` (m).

    positions (n, 3), m; covariances (n, 3, 3), m^2, body frame; rows must be finite to be drawn.
    """
    good = np.isfinite(positions).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    if not good.any():
        return None
    values, vectors = np.linalg.eigh(covariances[good])
    sigma = np.sqrt(np.maximum(values, 0.0))
    factor, short = drawn_scale(sigma[:, 2], wanted)
    every = -(-int(good.sum()) // _MAX_FRAMES)
    ball, faces, _ = Capsule(1.0, 0.0).mesh(faces=200 if good.sum() <= 150 else 72)
    axes = ((factor * short)[:, None, None] * sigma[:, None, :] * vectors)[::every]
    cut = int(np.sum(short < 1.0))
    points = positions[good][::every, None] + np.einsum("nij,vj->nvi", axes, ball)
    shifted = faces[None] + len(ball) * np.arange(len(points))[:, None, None]
    return _mesh(points.reshape(-1, 3), shifted.reshape(-1, 3)) | {
        "name": f"1 sigma along the skin × {grouped(factor)}"
        + (f" ({cut} drawn smaller)" if cut else ""),
        "color": theme.ESTIMATE,
        "opacity": 0.35,
        "flatshading": False,
        "lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0.0},
        "hoverinfo": "skip",
        "showlegend": True,
    }


def section(data: ReportData) -> str:
    """The 3D view with its caption."""
    body = data.body
    below = body is not None and data.recording is not None and _below(body, data.recording)
    caption = "Drag to rotate, scroll to zoom, click a legend entry to hide or show it"
    if np.isfinite(data.display_positions).any():
        caption += (
            "; point at a taxel to see its numbers. Frames: x red, y green, z (outward) blue. "
            "Ellipsoids: stated 1 sigma along the skin, enlarged by the factor in the legend"
        )
    caption += "."
    if body is not None and len(body.facets.faces) > MAX_FACES:
        caption += " The mesh of the body is simplified away from the skin."
    if below:
        caption += " The body is transparent: the contacts are below its surface."
    return markup.view_3d(view_3d(data, transparent=below), caption)


def _below(body: Body, recording: Recording) -> bool:
    """Whether most contacts are more than SUNK below the surface."""
    points = recording.points[:: max(len(recording.points) // 100, 1)]
    return len(points) > 0 and float(np.median(body.closest(points).distance)) < -SUNK


def view_3d(data: ReportData, transparent: bool) -> dict[str, Any]:
    """The figure {"data", "layout"} for plotly.js; transparent: the body, where contacts are below
    its surface.
    """
    names, poses = data.calibration.ids, np.asarray(data.calibration.poses, dtype=float)
    positions, cov, true = poses[:, :3, 3], data.covariances, data.true_poses
    skin, extent = data.display_positions, data.display_positions
    between = pitch(skin)
    traces: list[dict[str, Any]] = []
    if data.body is not None:
        mesh = data.body.facets
        traces.append(body(mesh.vertices, mesh.faces, skin, 0.06 * between, transparent))
        extent = np.concatenate([skin, mesh.vertices])
    if data.recording is not None and len(data.recording.points):
        traces.append(_route(data.recording, len(finite_rows(positions)) > 0))
        extent = _with_path(extent, data.recording.points)
    if true is not None:
        traces += _true_taxels(names, true, between)
    traces.append(_estimated_taxels(names, poses, cov, true))
    seen = np.any(np.asarray(data.calibration.observed)[:, 5])
    heading = "" if seen else " (heading: by convention)"
    traces += frames(poses, FRAME_LENGTH * between, f"estimated frames{heading}")
    if data.truth is None and np.isfinite(data.residuals).any():
        traces.append(_residuals(data))
    if (balls := ellipsoids(positions, cov, 0.3 * between)) is not None:
        traces.append(balls)
    looked_at, normals = skin, data.shown_poses[:, :3, 2]
    if data.recording is not None and not np.isfinite(skin).any():
        looked_at, normals = data.recording.points, data.recording.normals
    return {"data": traces, "layout": layout(looked_at, normals, extent)}


def _with_path(extent: Array, path: Array) -> Array:
    """Points (n, 3), m, of what is drawn and those of a path that may be off it, but not farther
    from its middle than its diagonal: such points would leave nothing else to see."""
    if not np.isfinite(extent).any():
        return path
    low, high = np.nanmin(extent, axis=0), np.nanmax(extent, axis=0)
    off = np.linalg.norm(path - (low + high) / 2, axis=1)
    return np.concatenate([extent, path[off < np.linalg.norm(high - low)]])


def _route(recording: Recording, located: bool) -> dict[str, Any]:
    """The path of the contact; where no taxel is located, its points are what is to be seen."""
    path, _ = path_with_breaks(recording.points, recording.time)
    dots = {"color": theme.MUTED if located else theme.WARNING, "size": 1 if located else 3}
    style = {"line": {"color": theme.MUTED, "width": 2}, "marker": dots, "hoverinfo": "skip"}
    return _scatter("path of the contact", path, "lines+markers", **style)


def _true_taxels(ids: Array, poses: Array, pitch: float) -> list[dict[str, Any]]:
    """Marks at the true taxels (n, 4, 4), and their frames, hidden at first."""
    style = {"symbol": "circle-open", "size": 7, "color": theme.TRUTH, "line": {"width": 2}}
    marks = _markers("true taxels", poses[:, :3, 3], [f"true taxel {k}" for k in ids], **style)
    return [marks, *frames(poses, FRAME_LENGTH * pitch, "true frames", visible=False)]


def _estimated_taxels(ids: Array, poses: Array, cov: Array, true: Array | None) -> dict[str, Any]:
    """Marks at the estimates, with uncertainty and, if the truth is known, error as text."""
    positions = poses[:, :3, 3]
    good = np.isfinite(positions).all(axis=1)
    truth = None if true is None else true[good, :3, 3]
    texts = _texts(ids[good], positions[good], truth, cov[good])
    return _markers("estimated taxels", positions[good], texts, size=3.2, color=theme.ESTIMATE)


def _residuals(data: ReportData) -> dict[str, Any]:
    """Marks at the estimates, hidden at first, whose colour is the size of the residuals."""
    r = data.residuals
    good = np.isfinite(r)
    texts = [
        f"taxel {k}<br>residuals {significant(float(x))} times the median taxel's"
        for k, x in zip(np.asarray(data.calibration.ids)[good], r[good], strict=True)
    ]
    bar = {"title": {"text": "residual"}, "thickness": 12, "len": 0.6}
    marks = _markers(
        "residuals", data.display_positions[good], texts, size=7, color=_packed(r[good]),
        colorscale="Cividis", cmin=0.0, cmax=maps.residual_scale(r), showscale=True, colorbar=bar,
    )  # fmt: skip
    return {**marks, "visible": "legendonly"}


def _texts(ids: Array, positions: Array, truth: Array | None, cov: Array) -> list[str]:
    sigma = np.sqrt(np.maximum(np.trace(cov, axis1=1, axis2=2), 0.0)) * MM
    texts = [f"taxel {k}<br>sigma {significant(s)} mm" for k, s in zip(ids, sigma, strict=True)]
    if truth is not None:
        error = np.linalg.norm(positions - truth, axis=1) * MM
        texts = [f"{t}<br>error {significant(e)} mm" for t, e in zip(texts, error, strict=True)]
    return texts


def layout(skin: Array, normals: Array, extent: Array) -> dict[str, Any]:
    """Axes around everything, and a camera that looks at the skin from outside."""
    low, high = _bounds(extent)
    size = float(np.max(high - low))
    plane = tangent_plane(skin, normals)
    radius = np.linalg.norm(finite_rows(skin) - plane.origin, axis=1).max(initial=0.05 * size)
    across, up = plane.axes
    direction = np.cross(across, up) * 0.88 - up * 0.42 + across * 0.2
    direction /= np.linalg.norm(direction)
    upward = np.cross(direction, np.cross(up, direction))
    middle = (low + high) / 2

    def camera(focus: Array, points: Array) -> dict[str, Any]:
        """From the front of the skin, so far that all points are seen; in sizes of the whole."""
        far = _distance(points - focus, direction, up) / size
        centre = (focus - middle) / size - LOWERED * far * upward
        eye = centre + direction * far
        return {"center": _vector(centre), "eye": _vector(eye), "up": _vector(up)}

    around = plane.origin + float(radius) * np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3)
    cameras = {"whole body": camera(middle, corners), "skin": camera(plane.origin, around)}
    menu = {"type": "buttons", "direction": "left", "x": 0.0, "y": 1.0, "xanchor": "left",
            "yanchor": "bottom", "showactive": False, "pad": {"b": 4}}  # fmt: skip
    menu["buttons"] = [
        {"label": name, "method": "relayout", "args": [{"scene.camera": seen}]}
        for name, seen in cameras.items()
    ]
    return {
        "scene": {
            **_axes(low, high, direction),
            "aspectmode": "manual",
            "aspectratio": _vector((high - low) / size),
            "camera": cameras["whole body"],
        },
        "margin": {"l": 0, "r": 0, "t": 36, "b": 0},
        "legend": {"orientation": "h", "x": 0.0, "y": 0.0, "yanchor": "top"},
        "updatemenus": [menu],
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": theme.INK},
        "paper_bgcolor": "#ffffff",
    }


def _bounds(extent: Array) -> tuple[Array, Array]:
    """The least and the largest coordinates (3,), m, of points (n, 3), with a margin."""
    extent = finite_rows(extent)
    low, high = (extent.min(axis=0), extent.max(axis=0)) if len(extent) else np.zeros((2, 3))
    pad = 0.03 * float(np.max(high - low)) or 0.01
    return low - pad, high + pad


def _vector(values: Array) -> dict[str, float]:
    return dict(zip("xyz", np.round(values, 6).tolist(), strict=True))


def _axes(low: Array, high: Array, direction: Array) -> dict[str, Any]:
    """The three axes, from `low` to `high` (3,), m, which a camera in `direction` (3,) sees."""
    shown = (high - low) * np.sqrt(1 - direction**2) / np.max(high - low)
    ticks = np.clip(np.round(TICKS * shown), FEWEST_TICKS, TICKS).astype(int).tolist()
    return {
        f"{axis}axis": {
            "title": {"text": f"{axis} (mm)"},
            "range": [low[k] * MM, high[k] * MM],
            "gridcolor": "#e4e7eb",
            "zeroline": False,
            "showspikes": False,
            "backgroundcolor": "#ffffff",
            "nticks": ticks[k],
        }
        for k, (axis, _) in enumerate(_COLOURS)
    }


def _distance(points: Array, direction: Array, up: Array) -> float:
    """Distance, m, along `direction` from the origin from which the camera sees points (n, 3)."""
    if not len(points):
        return 1.0
    right = np.cross(up, direction)
    right /= np.linalg.norm(right)
    across, high = np.abs(points @ right), np.abs(points @ np.cross(direction, right))
    half = np.maximum(high, across / WIDTH) / FIELD_OF_VIEW
    return float(np.max(half + points @ direction))
