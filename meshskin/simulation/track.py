"""The path as the closed loop follows it: references, and the mesh face under each of them.

Where the path crosses to another face, an affine map carries the foot point's (u, v) over, so that
a block of steps runs across faces without interruption. All maps of a path are prepared at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.se3 import transform
from ..exploration.path import Path, body_twists
from ..geometry.surface.surface import Surface

FACE_MARGIN = 0.25
"""Largest distance, in barycentric weight, of the foot point outside its face. A patch is a
polynomial that continues there; beyond, the foot point is searched for on the mesh."""
IDENTITY_MAP = np.eye(2, 3).T.ravel()
"""The map, column-major (6,), of a foot point that stays on its face."""


@dataclass(frozen=True)
class Track:
    """Rows of a path, or of a part of one."""

    references: Array
    """(k, 18), see closed_loop_model.REFERENCE."""
    faces: NDArray[np.intp]
    """Face of the mesh under each row (k,)."""
    maps: Array
    """Maps (k, 6) from the face of the row before, see closed_loop_model.ANCHOR."""

    @classmethod
    def of(cls, path: Path, surface: Surface) -> Track:
        """The rows of a path over a surface."""
        faces = np.asarray(path.faces)
        maps = np.tile(IDENTITY_MAP, (len(faces), 1))
        new = np.flatnonzero(np.diff(faces)) + 1
        maps[new] = face_maps(surface, faces[new - 1], faces[new])
        return cls(path.references, faces, maps)

    @classmethod
    def through(cls, poses: Array, dt: float, face: int) -> Track:
        """The rows through body poses T_w_b (k, 4, 4), one a step, over one face."""
        path = Path(
            dt, poses[:, :3, 3], poses[:, :3, 2], poses, body_twists(poses, dt), np.zeros(0, int)
        )
        return cls(path.references, np.zeros(0, int), np.zeros((0, 6))).on_face(face)

    def __len__(self) -> int:
        return len(self.references)

    def __getitem__(self, rows: slice) -> Track:
        return Track(self.references[rows], self.faces[rows], self.maps[rows])

    def on_face(self, face: int) -> Track:
        """These references, all over one face."""
        count = len(self.references)
        return replace(self, faces=np.full(count, face), maps=np.tile(IDENTITY_MAP, (count, 1)))

    def hold(self, row: int, count: int) -> Track:
        """`count` rows at rest at the pose of one row."""
        reference = np.concatenate([self.references[row, :12], np.zeros(6)])
        return replace(self, references=np.tile(reference, (count, 1))).on_face(
            int(self.faces[row])
        )


def reference_poses(references: Array) -> Array:
    """T_w_b (..., 4, 4) of references (..., 18)."""
    rotation = np.swapaxes(references[..., 3:12].reshape(*references.shape[:-1], 3, 3), -1, -2)
    return transform(rotation, references[..., :3])


def face_maps(surface: Surface, before: NDArray[np.intp], after: NDArray[np.intp]) -> Array:
    """Maps (k, 6), column-major, of (u, v, 1) from faces `before` (k,) to faces `after` (k,).

    A point of the first face's plane is projected onto the second's along the second's normal:
    exact on a common edge.
    """
    a, b = (surface.vertices[surface.faces[f]] for f in (before, after))
    edges = b[:, 1:] - b[:, :1]  # (k, 2, 3)
    points = np.concatenate([a[:, 1:] - a[:, :1], a[:, :1] - b[:, :1]], axis=1)  # (k, 3, 3)
    maps = np.linalg.solve(edges @ edges.swapaxes(1, 2), edges @ points.swapaxes(1, 2))
    return np.asarray(maps.swapaxes(1, 2).reshape(-1, 6))


def map_foot(face_map: Array, uv: Array) -> Array:
    """Foot points (..., 2) mapped by column-major maps (..., 6)."""
    columns = face_map.reshape(*face_map.shape[:-1], 3, 2)
    return np.asarray(
        uv[..., :1] * columns[..., 0, :] + uv[..., 1:] * columns[..., 1, :] + columns[..., 2, :]
    )


def face_margin(uv: Array) -> Array:
    """Least barycentric weight (...) of foot points (..., 2): negative outside their face."""
    return np.minimum(uv.min(axis=-1), 1.0 - uv.sum(axis=-1))
