"""A renderer of matplotlib that makes an SVG and a raster of a figure in one drawing.

To lay out ticks and texts takes most of the time of a drawing. What is drawn on the SVG, which has
72 units an inch, is drawn on the raster, too, larger by its pixels per unit.
"""

from __future__ import annotations

from io import StringIO
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import RendererSVG
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D, TransformedPath

from ..core.arrays import Array

UNITS = 72
"""Units per inch of an SVG."""


class Renderer(RendererSVG):
    """An SVG renderer that repeats everything on a raster."""

    def __init__(self, width: float, height: float, dpi: float, file: StringIO) -> None:
        """width, height: inches; dpi: pixels per inch of the raster."""
        size = UNITS * width, UNITS * height
        super().__init__(*size, file, image_dpi=dpi, metadata={"Date": None})
        self.raster = RendererAgg(dpi * width, dpi * height, dpi)
        self.up = Affine2D().scale(dpi / UNITS)
        self._drawn = False
        """Whether the raster has what comes next: the parts of a collection."""

    def _clipped(self, context: Any) -> Any:
        """The graphics context on the raster."""
        out = self.raster.new_gc()
        out.copy_properties(context)
        if (box := context.get_clip_rectangle()) is not None:
            out.set_clip_rectangle(box.transformed(self.up))
        path, transform = context.get_clip_path()
        if path is not None:
            out.set_clip_path(TransformedPath(path, transform + self.up))
        return out

    def draw_path(self, gc: Any, path: Any, transform: Any, rgbFace: Any = None) -> None:
        """Draw a path."""
        if not self._drawn:
            self.raster.draw_path(self._clipped(gc), path, transform + self.up, rgbFace)
        super().draw_path(gc, path, transform, rgbFace)

    def draw_markers(
        self, gc: Any, marker: Any, to_marker: Any, path: Any, transform: Any, rgbFace: Any = None
    ) -> None:
        """Draw a marker at each point of a path."""
        scaled = to_marker + self.up, path, transform + self.up
        self.raster.draw_markers(self._clipped(gc), marker, *scaled, rgbFace)
        super().draw_markers(gc, marker, to_marker, path, transform, rgbFace)

    def draw_path_collection(
        self, gc: Any, master: Any, paths: Any, each: Any, offsets: Any, offset: Any, *args: Any,
        **kwargs: Any,
    ) -> None:  # fmt: skip
        """Draw many paths."""
        scaled = master + self.up, paths, each, offsets, offset + self.up
        self.raster.draw_path_collection(self._clipped(gc), *scaled, *args, **kwargs)
        self._drawn = True
        super().draw_path_collection(gc, master, paths, each, offsets, offset, *args, **kwargs)
        self._drawn = False

    def draw_image(self, gc: Any, x: float, y: float, im: Any, transform: Any = None) -> None:
        """Draw an image, whose pixels are those of the raster."""
        self.raster.draw_image(self._clipped(gc), *self.up.transform((x, y)), im)
        super().draw_image(gc, x, y, im, transform)

    def draw_text(self, gc: Any, x: float, y: float, *args: Any, **kwargs: Any) -> None:
        """Draw a text."""
        self.raster.draw_text(self._clipped(gc), *self.up.transform((x, y)), *args, **kwargs)
        super().draw_text(gc, x, y, *args, **kwargs)


def draw(figure: Figure) -> tuple[Array, str]:
    """Draw a figure: pixels (rows, columns, 3) at its dpi, and the text of an SVG."""
    (width, height), dpi, text = figure.get_size_inches(), figure.get_dpi(), StringIO()
    both = Renderer(width, height, dpi, text)
    figure.set_dpi(UNITS)
    mixed = MixedModeRenderer(figure, width, height, dpi, both)
    figure.draw(mixed)
    figure.set_dpi(dpi)
    mixed.finalize()
    return np.asarray(both.raster.buffer_rgba())[..., :3], text.getvalue()
