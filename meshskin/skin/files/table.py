"""The rows of a skin file as written, and what several formats share."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import se3
from ...core.arrays import Array, Index
from ...core.errors import SkinError
from ..slots import CENTRE, PER_MODULE, THERMAL, Ids, module, slot

DISC_RADIUS = 2e-3
"""Radius of the disc of a taxel where none is given, m: that of the paper's skin
(bodies/sphere.toml)."""
LAST_DIGIT = 1e-6
"""Distance, m, up to which positions count as equal: the last digit that skin files carry."""
FRAME_TOLERANCE = 1e-3
"""Largest difference between a normal and the z axis of its quaternion, and between a quaternion's
norm and 1: four printed digits leave 1e-4."""
SPIKE_WIDTH = 0.12
"""Base of the spikes of `frame_mesh`, relative to their length: for viewers."""
TAXEL_NAME = r"(.+)_skin_(-?\d+)"
"""Expression of the names of the frames of taxels: `<part>_skin_<id>`."""
MIN_CENTRES = 8
"""Slots of a module whose taxel2Repr is the centre taxel, from which on it is triangular: ten are
on a whole one, of which two may be missing."""


@dataclass(frozen=True, eq=False)
class SkinTable:
    """Rows of a skin file as written."""

    format: str
    """name of the format"""
    ids: Ids
    """(n,) ids of the rows that are not empty"""
    positions: Array
    """(n, 3) in the frame of the body or link, m"""
    normals: Array
    """(n, 3) as written; zero where the file has none"""
    quaternions: Array | None = None
    """(n, 4) xyzw of the frames, if the file has them"""
    disc_radius: float = DISC_RADIUS
    """m"""
    slots: int | None = None
    """number of rows of a file with one row for each slot, empty ones included"""
    representative: Ids | None = None
    """(k,) taxel2Repr: for each slot the taxel that represents its module; negative: no taxel"""
    sigmas: Array | None = None
    """(n,) standard deviations of the positions, m, NaN where the file has none; None: no such"""
    frame: str | None = None
    """name of the frame of the positions, where the file names it"""

    @classmethod
    def of_poses(
        cls, format: str, ids: ArrayLike, poses: Array, disc_radius: float,
        sigmas: Array | None, frame: str | None,
    ) -> SkinTable:  # fmt: skip
        """The rows of a file with frames: poses (n, 3 or 4, 4).

        A matrix that is not a rotation has the quaternion zero.
        """
        rotations, quaternions = poses[:, :3, :3], np.zeros((len(poses), 4))
        off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        # three printed digits leave up to 2e-3 in R^T R; the comparison is False for NaN
        valid = (off < 5 * FRAME_TOLERANCE) & (np.linalg.det(rotations) > 0.0)
        quaternions[valid] = se3.quaternion(rotations[valid])
        columns = np.array(ids, dtype=np.int64), poses[:, :3, 3], poses[:, :3, 2], quaternions
        return cls(format, *columns, disc_radius, sigmas=sigmas, frame=frame)

    @classmethod
    def of_quaternions(
        cls, format: str, ids: ArrayLike, rows: Array, disc_radius: float,
        sigmas: Array | None, frame: str | None,
    ) -> SkinTable:  # fmt: skip
        """The rows (n, 7) of a file with positions, m, and quaternions, xyzw.

        A quaternion without a length has the normal zero.
        """
        from scipy.spatial.transform import Rotation

        quaternions, normals = rows[:, 3:], np.zeros((len(rows), 3))
        valid = np.linalg.norm(quaternions, axis=1) > 0.0  # False for NaN
        normals[valid] = Rotation.from_quat(quaternions[valid]).as_matrix()[:, :, 2]
        columns = np.array(ids, dtype=np.int64), rows[:, :3], normals, quaternions
        return cls(format, *columns, disc_radius, sigmas=sigmas, frame=frame)

    def is_thermal(self) -> NDArray[np.bool_]:
        """Which rows (n,) are thermal pads: slots 6 and 10 of a triangular module."""
        if self.slots is None:
            return np.zeros(len(self.ids), dtype=bool)
        return np.isin(slot(self.ids), THERMAL) & self.is_triangular(module(self.ids))

    def is_triangular(self, modules: Ids) -> NDArray[np.bool_]:
        """Which of the modules (m,) of a file with slots are triangular, by taxel2Repr.

        Most of its slots name the centre taxel, or none a taxel. Modules that are not listed count
        as triangular.
        """
        listed = np.zeros(0, dtype=np.int64) if self.representative is None else self.representative
        whole = len(listed) // PER_MODULE
        listed = listed[: whole * PER_MODULE].reshape(whole, PER_MODULE)
        centre = PER_MODULE * np.arange(whole) + CENTRE
        triangular = np.sum(listed == centre[:, None], axis=1) >= MIN_CENTRES
        triangular |= np.all(listed < 0, axis=1)
        return np.array([m >= whole or bool(triangular[m]) for m in modules.tolist()], dtype=bool)

    def is_taxel(self) -> NDArray[np.bool_]:
        """Which rows (n,) are taxels: those that taxel2Repr lists; beyond it all but thermal."""
        if self.slots is None:
            return np.ones(len(self.ids), dtype=bool)
        taxel = ~self.is_thermal()
        if self.representative is not None:
            known = self.ids < len(self.representative)
            taxel[known] = self.representative[self.ids[known]] >= 0
        return taxel

    def take(self, rows: NDArray[np.bool_] | Index) -> SkinTable:
        """Some rows, without the information on slots."""
        names = ("ids", "positions", "normals", "quaternions", "sigmas")
        columns = {name: getattr(self, name) for name in names}
        kept: dict[str, Any] = {k: None if c is None else c[rows] for k, c in columns.items()}
        return replace(self, **kept, slots=None, representative=None)

    def poses(self, name: str) -> Array:
        """Poses (n, 4, 4) in the body frame; rotations are NaN where the file has no normal.

        Without quaternions the rotation about the normal is that of `se3.orthonormal_basis`. `name`
        of the file is for errors: SkinError for repeated ids, numbers that are not finite, and
        quaternions that are not of unit norm or disagree with their normal.
        """
        values, counts = np.unique(self.ids, return_counts=True)
        if np.any(counts > 1):
            raise damaged(f"{name} names a taxel twice", int(values[counts > 1][0]))
        numbers = [self.positions, self.normals]
        numbers += [] if self.quaternions is None else [self.quaternions]
        finite = np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            where = f"{name}, taxel line {row + 1}"
            raise damaged(f"{where}: numbers of taxel {self.ids[row]} must be finite")
        if self.quaternions is not None:
            return se3.transform(self._rotations(name, self.quaternions), self.positions)
        length = np.linalg.norm(self.normals, axis=1, keepdims=True)
        normals = np.divide(
            self.normals, length, out=np.full_like(self.normals, np.nan), where=length > 0
        )
        return se3.transform(se3.orthonormal_basis(normals), self.positions)

    def _rotations(self, name: str, quaternions: Array) -> Array:
        """Rotations (n, 3, 3) of unit quaternions that agree with the normals. Raises SkinError."""
        from scipy.spatial.transform import Rotation

        length = np.linalg.norm(quaternions, axis=1)
        row = int(np.argmax(np.abs(length - 1.0)))
        if abs(length[row] - 1.0) > FRAME_TOLERANCE:
            what = f"{name}, taxel line {row + 1}: the frame must be a rotation"
            if length[row] == 0.0:  # of a matrix, too
                raise damaged(what, "axes that are not orthonormal and right-handed, or all zero")
            value, limit = f"quaternion of norm {length[row]:.4g}", f"1 within {FRAME_TOLERANCE:g}"
            raise damaged(what, value, limit)
        rotation = Rotation.from_quat(quaternions).as_matrix()
        off = np.linalg.norm(rotation[:, :, 2] - self.normals, axis=1)
        row = int(np.argmax(off))
        if off[row] > FRAME_TOLERANCE:
            what = f"{name}, taxel line {row + 1}: normal and quaternion disagree"
            raise damaged(what, f"{off[row]:.3g}", f"{FRAME_TOLERANCE:g}")
        return np.asarray(rotation)


@dataclass(frozen=True, eq=False)
class SkinRows:
    """What a skin file is written from."""

    poses: Array
    """(n, 4, 4) in the frame `link`; NaN rotations where there is no normal"""
    ids: Ids
    """(n,)"""
    disc_radius: float
    """m"""
    link: str
    """name of the frame, of which those of taxels are `<link>_skin_<id>`"""
    sigmas: Array | None = None
    """(n,) standard deviations of the positions, m, not finite where unknown; None: unknown"""
    parent: str | None = None
    """URDF formats: link to which `link` is fixed; None: none"""

    def sigma_texts(self) -> list[str]:
        """The sigma of each taxel, m, as text that is read back exactly; "" where unknown."""
        if self.sigmas is None:
            return [""] * len(self.ids)
        return [repr(x) if np.isfinite(x) else "" for x in np.asarray(self.sigmas, float).tolist()]

    def each(self) -> Iterator[tuple[int, Array, str]]:
        """Id, pose (4, 4) and text of the sigma of each taxel."""
        return zip(self.ids.tolist(), self.poses, self.sigma_texts(), strict=True)


def damaged(
    where: str, value: object = None, limit: object = None, remedy: str = "correct it there"
) -> SkinError:
    """The error for a file that cannot be read; `where` names the file, and the place in it."""
    return SkinError(where, value=value, limit=limit, remedy=remedy)


def parse_id(text: str, where: str, kind: type[np.signedinteger[Any]] = np.int64) -> int:
    """The id of a taxel or module. Raises SkinError for a text that is not an integer of `kind`."""
    try:
        return int(kind(int(text)))
    except (ValueError, OverflowError) as error:
        limit = f"an integer of {np.iinfo(kind).bits} bits"
        raise damaged(f"{where}: id", repr(text[:40]), limit) from error


def check_ids(ids: Ids, kind: str, least: int, most: int) -> None:
    """Raise SkinError unless all ids (n,) are in the range that a format can hold."""
    for worst in (int(ids.min()), int(ids.max())):
        if not least <= worst <= most:
            raise SkinError(
                f"a taxel id does not fit a {kind} file", value=worst, limit=f"{least} to {most}",
                remedy="write another format, or number the taxels anew",
            )  # fmt: skip


def parse_sigmas(texts: Sequence[str | None], where: str) -> Array | None:
    """Sigmas (n,), m, of texts, NaN for empty ones; None where all are. Raises SkinError."""
    if not any(texts):
        return None
    return np.array([parse_numbers([t], 1, f"{where}: sigma")[0] if t else np.nan for t in texts])


def parse_numbers(fields: list[str], count: int, where: str, limit: str | None = None) -> Array:
    """`count` numbers of a file. Raises SkinError for anything else; `where` names their place."""
    try:
        values = np.array([float(field) for field in fields])
    except ValueError as error:
        raise damaged(where, error) from error
    if len(values) != count:
        raise damaged(where, f"{len(values)} numbers", limit or f"{count} numbers")
    return values


def number_text(values: Array) -> str:
    """Numbers as text that is read back exactly."""
    return " ".join(repr(value) for value in np.asarray(values, dtype=float).tolist())


def place_texts(pose: Array) -> dict[str, str]:
    """The attributes xyz and rpy of a pose (4, 4) in a URDF, read back by `pose_of`."""
    return {"xyz": number_text(pose[:3, 3]), "rpy": number_text(se3.to_rpy(pose[:3, :3]))}


def pose_of(element: ET.Element | None, where: str) -> Array:
    """The pose (4, 4) of an element of a URDF with xyz and rpy. Raises SkinError."""
    given = {} if element is None else element.attrib
    xyz, rpy = (parse_numbers(given.get(k, "0 0 0").split(), 3, where) for k in ("xyz", "rpy"))
    return se3.transform(se3.from_rpy(rpy), xyz)


def named_parts(
    elements: Iterable[ET.Element], where: str, suffix: str = ""
) -> dict[str, list[tuple[int, ET.Element]]]:
    """The ids and elements of the names `<part>_skin_<id>`, by part; suffix: expression of what may
    follow in a name. Raises SkinError for an id that is too large; `where` names the file."""
    found: dict[str, list[tuple[int, ET.Element]]] = {}
    for element in elements:
        if match := re.fullmatch(TAXEL_NAME + suffix, element.get("name", "")):
            one = parse_id(match[2], where), element
            found.setdefault(match[1], []).append(one)
    return found


def chosen_part(part: str | None, parts: Mapping[str, object], name: str) -> str:
    """`part`, or the only one of the parts of a file. Raises SkinError."""
    if part is None and len(parts) == 1:
        return next(iter(parts))
    if part is None or part not in parts:
        raise SkinError(
            f"{name} has several parts" if part is None else f"{name} has no part {part!r}",
            limit=", ".join(parts),
            remedy="choose one with part= (--part), or give a file of one",
        )
    return part


def frame_mesh(disc_radius: float) -> tuple[Array, Index, NDArray[np.uint8]]:
    """A taxel's frame for viewers: vertices (12, 3), m, faces (12, 3) and vertex colours (12, 4).

    Three spikes: x red, y green, each as long as the disc's radius; z (the normal) blue and twice
    as long.
    """
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    base = SPIKE_WIDTH * np.column_stack([np.zeros(3), np.cos(angle), np.sin(angle)])
    vertices, faces = [], []
    for axis, length in enumerate((1.0, 1.0, 2.0)):
        vertices.append(np.roll(np.vstack([base, [length, 0.0, 0.0]]), axis, axis=1))
        faces.append(4 * axis + np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    colours = [[200, 40, 40, 255], [40, 160, 60, 255], [40, 80, 200, 255]]
    rows = np.repeat(np.array(colours, dtype=np.uint8), 4, axis=0)
    return disc_radius * np.concatenate(vertices), np.concatenate(faces), rows
