"""The section of the page with the 3D view: its data, and its caption."""

from __future__ import annotations

import numpy as np

from ..geometry.body import Body
from ..recording.recording import Recording
from . import scene3d
from .data import ReportData
from .markup import view_3d

SUNK = 1e-3
"""Depth of the contacts below the body, m, from which it hides them."""


def section(data: ReportData) -> str:
    """The view with its caption."""
    c, body = data.calibration, data.body
    below = body is not None and data.recording is not None and _below(body, data.recording)
    figure = scene3d.view_3d(
        ids=c.ids,
        poses=c.poses,
        covariances=data.covariances,
        mesh=None if body is None else (body.facets.vertices, body.facets.faces),
        truth=data.true_poses,
        path=None if data.recording is None else (data.recording.points, data.recording.time),
        heading_observed=bool(np.any(np.asarray(c.observed)[:, 5])),
        transparent=below,
    )
    caption = (
        "Drag to rotate, scroll to zoom, click a legend entry to hide or show it; point at a taxel "
        "to see its numbers. Frames: x red, y green, z (outward) blue. Ellipsoids: stated 1 sigma "
        "along the skin, enlarged by the factor in the legend."
    )
    if body is not None and len(body.facets.faces) > scene3d.MAX_FACES:
        caption += " The mesh of the body is simplified away from the skin."
    if below:
        caption += " The body is transparent: the contacts are below its surface."
    return view_3d(figure, caption)


def _below(body: Body, recording: Recording) -> bool:
    """Whether most contacts are more than SUNK below the surface."""
    points = recording.points[:: max(len(recording.points) // 100, 1)]
    return len(points) > 0 and float(np.median(body.closest(points).distance)) < -SUNK
