"""Skins as NumPy archives: `poses` (n, 3, 4), whose third column is the outward normal, and
`taxel2pixel` (n, 2), row and column of each taxel in a tactile image; beside them `ids` (n,),
`disc_radius_m`, `frame`, the name of the link or body, and `sigma_m` (n,) where known.

Tactile patterns of simulators have this form (CustomPatternCfg of Isaac Lab extensions). The image
is that of the ids from 0, or the smallest one, row by row, as square as these allow.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .table import DISC_RADIUS, SkinRows, SkinTable, damaged

_READ_ERRORS = (
    OSError, ValueError, EOFError, RuntimeError, MemoryError, struct.error, zipfile.BadZipFile,
    zlib.error,
)  # fmt: skip
"""Exceptions of NumPy and zipfile for a file that is damaged, encrypted or no archive."""


def write(rows: SkinRows) -> bytes:
    """Bytes of the archive; exact."""
    pixels = rows.ids - min(0, int(rows.ids.min()))
    width = math.isqrt(int(pixels.max())) + 1
    known: dict[str, Any] = {}
    if rows.sigmas is not None:
        known["sigma_m"] = np.asarray(rows.sigmas, dtype=float)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        poses=rows.poses[:, :3, :],
        taxel2pixel=np.column_stack([pixels // width, pixels % width]),
        ids=rows.ids,
        disc_radius_m=float(rows.disc_radius),
        frame=rows.link,
        **known,
    )
    return buffer.getvalue()


def read(data: bytes, name: str) -> SkinTable:
    """The taxels of an archive; without `ids` they are numbered from 0. Raises SkinError."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            found = {key: archive[key] for key in archive.files}
    except _READ_ERRORS as error:
        what = f"{name} is not a NumPy archive"
        raise damaged(what, str(error)[:80], remedy="write it again") from error
    n = len(found.get("poses", ()))
    poses = _column(found, "poses", np.floating, (n, 3, 4), name)
    ids = _column(found, "ids", np.integer, (n,), name) if "ids" in found else np.arange(n)
    sigmas = _column(found, "sigma_m", np.number, (n,), name) if "sigma_m" in found else None
    radius = DISC_RADIUS
    if "disc_radius_m" in found:
        radius = float(_column(found, "disc_radius_m", np.number, (), name))
    frame = str(found["frame"]) if "frame" in found else None
    return SkinTable.of_poses("npz", ids, poses.astype(float), radius, sigmas, frame)


def _column(
    found: dict[str, Any], key: str, kind: type, shape: tuple[int, ...], name: str
) -> NDArray[Any]:
    """One array of an archive. Raises SkinError unless it has this kind of numbers and shape."""
    array = found.get(key)
    if not isinstance(array, np.ndarray):
        raise damaged(f"{name} has no {key}", limit=f"an array of shape {shape}")
    if array.shape != shape or not np.issubdtype(array.dtype, kind):
        value, limit = f"{array.dtype} of shape {array.shape}", f"{kind.__name__} of shape {shape}"
        raise damaged(f"{name}: wrong {key}", value, limit)
    return array
