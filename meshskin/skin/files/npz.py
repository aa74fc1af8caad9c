"""Skins as NumPy archives: `poses` (n, 3, 4), whose third column is the outward normal, and
`taxel2pixel` (n, 2), row and column of each taxel in a tactile image; beside them `ids` (n,),
`disc_radius_m`, `frame`, the name of the link or body, and `sigma_m` (n,) where known.

Tactile patterns of simulators have this form (CustomPatternCfg of Isaac Lab extensions). The image
is that of the ids row by row, as square as these allow.
"""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np

from ...core.errors import SkinError
from .table import DISC_RADIUS, SkinRows, SkinTable


def write(rows: SkinRows) -> bytes:
    """Bytes of the archive; exact."""
    ids, width = rows.ids, math.isqrt(int(rows.ids.max(initial=0))) + 1
    known: dict[str, Any] = {}
    if rows.sigmas is not None:
        known["sigma_m"] = np.asarray(rows.sigmas, dtype=float)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        poses=rows.poses[:, :3, :],
        taxel2pixel=np.column_stack([ids // width, ids % width]),
        ids=ids,
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
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SkinError(f"{name} is not a NumPy archive", value=str(error)) from error
    poses = found.get("poses")
    if poses is None or poses.ndim != 3 or poses.shape[1:] != (3, 4):
        value = "none" if poses is None else f"shape {poses.shape}"
        raise SkinError(f"{name}: poses have the wrong shape", value=value, limit="(n, 3, 4)")
    ids = found.get("ids", np.arange(len(poses)))
    if ids.shape != (len(poses),) or not np.issubdtype(ids.dtype, np.integer):
        raise SkinError(
            f"{name}: ids must be one integer for each pose",
            value=f"{ids.dtype} of shape {ids.shape}",
            limit=f"({len(poses)},)",
        )
    sigmas = found.get("sigma_m")
    if sigmas is not None and sigmas.shape != (len(poses),):
        raise SkinError(
            f"{name}: sigma_m must be one number for each pose",
            value=f"shape {sigmas.shape}",
            limit=f"({len(poses)},)",
        )
    radius = float(found.get("disc_radius_m", DISC_RADIUS))
    frame = str(found["frame"]) if "frame" in found else None
    return SkinTable.of_poses("npz", ids, np.asarray(poses, dtype=float), radius, sigmas, frame)
