"""The path as the closed loop runs it: reference rows, and the face under each of them.

Where the path crosses to another face, the foot's (u, v) are carried over by an affine map, so that
a block of steps runs across faces without a stop. All is prepared for the whole path at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.se3 import Array, transform
from ..exploration.path import Path, body_twists
from ..geometry.surface.surface import Surface

STAY = np.eye(2, 3).T.ravel()
"""The map, column-major (6,), of a foot that stays on its face."""


@dataclass(frozen=True)
class Track:
    """Rows of a path, or a part of one."""

    references: Array
    """(k, 18), see loop.REFERENCE."""
    faces: NDArray[np.intp]
    """Face of the mesh under each row (k,)."""
    maps: Array
    """From the face of the row before (k, 6), see loop.ANCHOR."""

    @classmethod
    def of(cls, path: Path, surface: Surface) -> Track:
        """The whole path."""
        faces = np.asarray(path.faces)
        maps = np.tile(STAY, (len(faces), 1))
        new = np.flatnonzero(np.diff(faces)) + 1
        maps[new] = crossings(surface, faces[new - 1], faces[new])
        return cls(path.references, faces, maps)

    @classmethod
    def through(cls, poses: Array, dt: float, face: int) -> Track:
        """A way of the body through poses T_w_b (k, 4, 4), one a step, over one face."""
        path = Path(
            dt, poses[:, :3, 3], poses[:, :3, 2], poses, body_twists(poses, dt), np.zeros(0, int)
        )
        count = len(poses)
        return cls(path.references, np.full(count, face), np.tile(STAY, (count, 1)))

    def __len__(self) -> int:
        return len(self.faces)

    def __getitem__(self, rows: slice) -> Track:
        return Track(self.references[rows], self.faces[rows], self.maps[rows])

    def hold(self, row: int, count: int) -> Track:
        """`count` rows that rest at the pose of one row."""
        still = np.concatenate([self.references[row, :12], np.zeros(6)])
        faces = np.full(count, self.faces[row])
        return Track(np.tile(still, (count, 1)), faces, np.tile(STAY, (count, 1)))


def reference_poses(references: Array) -> Array:
    """T_w_b (..., 4, 4) of reference rows (..., 18)."""
    rotation = np.swapaxes(references[..., 3:12].reshape(*references.shape[:-1], 3, 3), -1, -2)
    return transform(rotation, references[..., :3])


def crossings(surface: Surface, before: NDArray[np.intp], after: NDArray[np.intp]) -> Array:
    """Maps (k, 6), column-major, of (u, v, 1) from faces `before` (k,) to faces `after` (k,).

    A point of the first face's plane goes to the second's along its normal: exact on a common edge.
    """
    a, b = (surface.vertices[surface.faces[f]] for f in (before, after))
    edges = b[:, 1:] - b[:, :1]  # (k, 2, 3)
    points = np.concatenate([a[:, 1:] - a[:, :1], a[:, :1] - b[:, :1]], axis=1)  # (k, 3, 3)
    change = np.linalg.solve(edges @ edges.swapaxes(1, 2), edges @ points.swapaxes(1, 2))
    return np.asarray(change.swapaxes(1, 2).reshape(-1, 6))
