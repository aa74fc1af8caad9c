"""What a skin file says, before anything is made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.errors import SkinError
from ..slots import CENTRE, PER_MODULE, THERMAL, module, slot

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

DISC_RADIUS = 2e-3
"""radius in m of a taxel's disc where the file gives none"""
MOST_OFF = 1e-3
"""difference between a written normal and its frame, or of a quaternion's length from 1"""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a skin file, as they are written."""

    format: str
    """the format's name"""
    ids: Ids
    """(n,) addresses of the rows that hold something"""
    positions: Array
    """(n, 3) m, body or link frame"""
    normals: Array
    """(n, 3) as written; zero where the file gives none"""
    quaternions: Array | None = None
    """(n, 4) xyzw of the frames, where the file gives them"""
    disc_radius: float = DISC_RADIUS
    """m"""
    slots: int | None = None
    """rows of a file that has one for each slot, with or without a taxel"""
    representative: Ids | None = None
    """(k,) taxel2Repr: of each slot the one that represents its module, negative: no taxel"""

    def is_thermal(self) -> NDArray[np.bool_]:
        """Which rows (n,) are thermal pads: slots 6 and 10 of a triangular module.

        taxel2Repr gives the modules that are not triangular away: they lack the centre taxel's
        name in most slots.
        """
        if self.slots is None:
            return np.zeros(len(self.ids), dtype=bool)
        return np.isin(slot(self.ids), THERMAL) & self.is_triangular(module(self.ids))

    def is_triangular(self, modules: Ids) -> NDArray[np.bool_]:
        """Which of the modules (m,) of a file with slots are triangular, by taxel2Repr."""
        representative = np.zeros(0, dtype=np.int64)
        if self.representative is not None:
            representative = self.representative
        whole = len(representative) // PER_MODULE
        listed = representative[: whole * PER_MODULE].reshape(whole, PER_MODULE)
        centre = PER_MODULE * np.arange(whole) + CENTRE
        plain = np.sum(listed == centre[:, None], axis=1) >= 8
        plain |= np.all(listed < 0, axis=1)
        return np.array([m >= whole or bool(plain[m]) for m in modules.tolist()], dtype=bool)

    def is_taxel(self) -> NDArray[np.bool_]:
        """Which rows (n,) are taxels: those that taxel2Repr lists; beyond it all but thermal."""
        if self.slots is None:
            return np.ones(len(self.ids), dtype=bool)
        taxel = ~self.is_thermal()
        if self.representative is not None:
            known = self.ids < len(self.representative)
            taxel[known] = self.representative[self.ids[known]] >= 0
        return taxel

    def take(self, rows: NDArray[np.bool_]) -> Table:
        """Some rows, without what the file says of slots."""
        quaternions = None if self.quaternions is None else self.quaternions[rows]
        return Table(
            self.format,
            self.ids[rows],
            self.positions[rows],
            self.normals[rows],
            quaternions,
            self.disc_radius,
        )

    def poses(self, name: str) -> Array:
        """Poses (n, 4, 4) in the body frame; rotations are NaN where the file gives no normal.

        A file without frames leaves the turn about the normal open: a fixed convention sets it.
        `name` is the file's, for the errors: SkinError where ids double or numbers are not finite.
        """
        values, counts = np.unique(self.ids, return_counts=True)
        if np.any(counts > 1):
            raise SkinError(f"{name} names a taxel twice", value=int(values[counts > 1][0]))
        finite = np.isfinite(self.positions).all(axis=1) & np.isfinite(self.normals).all(axis=1)
        if self.quaternions is not None:
            finite &= np.isfinite(self.quaternions).all(axis=1)
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            raise SkinError(
                f"{name}, taxel line {row + 1}: taxel {self.ids[row]}", limit="finite numbers"
            )
        if self.quaternions is not None:
            return se3.transform(self._rotations(name, self.quaternions), self.positions)
        length = np.linalg.norm(self.normals, axis=1, keepdims=True)
        normals = np.divide(
            self.normals, length, out=np.full_like(self.normals, np.nan), where=length > 0
        )
        return se3.transform(se3.orthonormal_basis(normals), self.positions)

    def _rotations(self, name: str, quaternions: Array) -> Array:
        from scipy.spatial.transform import Rotation

        length = np.linalg.norm(quaternions, axis=1)
        if np.any(np.abs(length - 1.0) > MOST_OFF):
            worst = int(np.argmax(np.abs(length - 1.0)))
            raise SkinError(
                f"{name}, taxel line {worst + 1}: length of the quaternion",
                value=f"{length[worst]:.4g}",
                limit="1",
            )
        rotation = Rotation.from_quat(quaternions).as_matrix()
        off = np.linalg.norm(rotation[:, :, 2] - self.normals, axis=1)
        if np.any(off > MOST_OFF):
            worst = int(np.argmax(off))
            raise SkinError(
                f"{name}, taxel line {worst + 1}: normal and quaternion disagree",
                value=f"{off[worst]:.3g}",
                limit=f"{MOST_OFF:g}",
            )
        return np.asarray(rotation)
