"""The search for closest points on a surface of patches, in NumPy.

A query starts at the nearest of a set of samples of the mesh, then walks: a Newton step on the
patch, and where the step leaves the face, on through the edge into the next face. Where creases,
borders or other sheets leave the end in doubt, it walks again from every face that may be nearer.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import patch, walk
from .proximity import Proximity

if TYPE_CHECKING:
    from .surface import Surface

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAMPLES = 20_000
"""samples, at least, of a mesh with creases, whose faces may be long"""
NEAR, WIDE = 24, 48
"""nearest samples whose faces are looked at for a start, and where a walk's end is in doubt"""


class Flat(NamedTuple):
    """Where the flat faces are nearest to n points."""

    face: Index
    """(n,)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""
    gap: Array
    """(n,) distances in m"""


class ClosestPoints(NamedTuple):
    """Closest points on the patches to n points."""

    face: Index
    """(n,)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""
    derivatives: tuple[Array, ...]
    """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches there"""
    flat: Flat | None
    """the nearest flat faces; None on a smooth surface, and with faces to start from"""


class Search:
    """Closest points on the patches of a surface."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface

    @cached_property
    def _proximity(self) -> Proximity:
        surface = self.surface
        least = 0 if surface.smooth else SAMPLES
        return Proximity(surface.vertices, surface.faces, least)

    def closest(self, p: Array, face: Index | None) -> ClosestPoints:
        """The feet of p (n, 3), m; `face` (n,): faces to start from, if known."""
        found, uv, flat = self._closest(p, face)
        return ClosestPoints(found, uv, self.derivatives(found, uv), flat)

    def _closest(self, p: Array, face: Index | None) -> tuple[Index, Array, Flat | None]:
        if self.surface.smooth:
            return *self._on_smooth(p, face), None
        flat = None
        if face is None:
            near = self._proximity.nearby(p, NEAR)
            row, first = np.arange(len(p)), np.argmin(near[1], axis=1)
            flat = Flat(near[0][row, first], near[2][row, first], near[1][row, first])
            foot, uv, hops = self._walk(p, flat.face, flat.uv)
            self._rivals(p, foot, uv, row, near)
            most = np.min(near[1] + self.surface.lifts[near[0]], axis=1)
            stuck = np.flatnonzero(self._gap(p, foot, uv) > 1.0001 * most)  # at a crease's end
            if len(stuck):
                again, k = np.repeat(stuck, near[0].shape[1]), near[0][stuck].ravel()
                self._try(p, foot, uv, again, k, np.full((len(k), 2), 1.0 / 3.0))
        else:
            foot, uv, hops = self._walk(p, face)
        doubtful = np.flatnonzero(hops >= walk.FAR)
        if len(doubtful):
            self._rivals(p, foot, uv, doubtful, self._proximity.nearby(p[doubtful], WIDE))
        return foot, uv, flat

    def descend(self, p: Array, face: Index) -> tuple[Index, Array]:
        """Faces (n,) and uv (n, 2) where walks from `face` (n,) towards p (n, 3), m, end."""
        return self._walk(p, face)[:2]

    def derivatives(self, face: Index, uv: Array) -> tuple[Array, ...]:
        """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches `face` (n,) at uv (n, 2)."""
        return patch.evaluate(self.surface.patches[face], uv[:, 0], uv[:, 1])

    def _on_smooth(self, p: Array, face: Index | None) -> tuple[Index, Array]:
        foot, uv, hops = self._walk(p, self._proximity.near(p) if face is None else face)
        far = np.flatnonzero(hops >= walk.FAR)
        if len(far):
            start = self._proximity.exact(p[far])
            self._try(p, foot, uv, far, start, np.full((len(far), 2), 1.0 / 3.0))
        return foot, uv

    def _rivals(
        self, p: Array, foot: Index, uv: Array, rows: Index, near: tuple[Index, Array, Array]
    ) -> None:
        """Walk again, in place, from every face whose patch may be nearer than what was found.

        `near`: flat faces near the points `rows` (k,), as of Proximity.nearby.
        """
        order = np.argsort(near[0], axis=1)
        faces = np.take_along_axis(near[0], order, axis=1)
        least = np.take_along_axis(near[1], order, axis=1) - self.surface.lifts[faces]
        found = self._gap(p[rows], foot[rows], uv[rows])
        wanted = (least < 0.9999 * found[:, None]) & (faces != foot[rows, None])
        wanted[:, 1:] &= faces[:, 1:] != faces[:, :-1]
        row, k = np.nonzero(wanted)
        if len(row):
            self._try(p, foot, uv, rows[row], faces[row, k], near[2][row, order[row, k]])

    def _try(
        self, p: Array, foot: Index, uv: Array, rows: Index, face: Index, start: Array
    ) -> None:
        """Walk from `face`, `start` for the points `rows` (k,), which may repeat; keep the best."""
        again, again_uv, _ = self._walk(p[rows], face, start)
        gap = self._gap(p[rows], again, again_uv)
        best = np.lexsort((gap, rows))
        best = best[np.unique(rows[best], return_index=True)[1]]
        here = rows[best]
        better = gap[best] < self._gap(p[here], foot[here], uv[here])
        foot[here[better]], uv[here[better]] = again[best[better]], again_uv[best[better]]

    def _walk(
        self, p: Array, face: Index, start: Array | None = None
    ) -> tuple[Index, Array, Index]:
        surface = self.surface
        across = surface.neighbours, surface.slot
        return walk.walk(surface.patches, across, p, face, walk.closest_step, start)

    def _gap(self, p: Array, face: Index, uv: Array) -> Array:
        """Distances (n,) in m from p to the surface at `face`, `uv`."""
        basis = patch.monomials(uv[:, 0], uv[:, 1])
        s = np.einsum("nk,nkc->nc", basis, self.surface.patches[face])
        return np.asarray(np.sqrt(np.sum((s - p) ** 2, axis=1)))
