"""Lighter contacts where the scene's force is refused.

A lighter contact has a smaller patch and depth: in hollows and near edges it is in the range of the
contact models where the scene's force leaves it. Forces are recorded with the contacts, so that the
calibration takes each at its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..contact.material import LIGHTER
from ..core.arrays import Array, runs
from ..core.errors import ContactError
from ..robot import collision
from ..robot.contact_rig import ContactRig
from ..scene.scene import Scene
from .path import Path

LIGHTER_HELPS = collision.HOLLOW, collision.EDGE, "does not hold"
"""Reasons, or parts of them, that a lighter contact may not have."""
AROUND = 1.5
"""Distance, in sensing radii, up to which lighter contacts serve a taxel."""


def lighter_helps(reasons: Sequence[str] | Array) -> NDArray[np.bool_]:
    """Whether (k,) a lighter contact may not have the reasons (k,)."""
    return np.array([any(part in why for part in LIGHTER_HELPS) for why in reasons], dtype=bool)


def lighter_rigs(scene: Scene) -> Iterator[tuple[float, ContactRig]]:
    """The lighter forces, N, of a scene, and the contact rigs at them."""
    for part in LIGHTER:
        force = part * scene.law.force_reference
        law = replace(scene.law, force_reference=force)
        lighter = scene.with_(contact=scene.model.name, law=law)
        with suppress(ContactError):  # the contact model does not hold at any taxel
            yield force, lighter.rig_of(lighter.patch, lighter.invalid_reasons)


def pressed_lighter(
    rig: ContactRig, points: Array, normals: Array, reason: Array, sites: Array | None = None
) -> NDArray[np.bool_]:
    """Which of the points (k, 3) that were refused, for a reason (k,), a lighter contact can press;
    their reasons are replaced.

    sites (n, 3): try points near these only.
    """
    from scipy.spatial import cKDTree

    tried = np.flatnonzero(lighter_helps(reason))
    if sites is not None and len(tried):
        near = AROUND * rig.sensing_radius
        tried = tried[cKDTree(sites).query(points[tried], distance_upper_bound=near)[0] <= near]
    found = np.zeros(len(points), dtype=bool)
    if len(tried):
        reason[tried] = rig.contact_reasons(points[tried], normals[tried])
        found[tried] = reason[tried] == ""
    return found


def grown_runs(new: NDArray[np.bool_], free: NDArray[np.bool_], short: int) -> list[slice]:
    """Runs of at least `short` samples of a lane around the new ones (n,), with neighbours that are
    free (n,), too."""
    from scipy.ndimage import binary_dilation

    grown = binary_dilation(new, iterations=short - 1) & free if new.any() else new
    return [run for run in runs(grown) if run.stop - run.start >= short]


def lighter_note(scene: Scene, path: Path) -> str:
    """Which part of a path is pressed lighter than with the scene's force; "" where none is."""
    full = scene.law.force_reference
    forces = np.array([]) if path.forces is None else np.asarray(path.forces)
    lighter = forces < full
    if not lighter.any():
        return ""
    part = np.diff([0, *path.breaks, len(path.points)])[lighter].sum() / len(path.points)
    words = " and ".join(f"{force:g}" for force in np.unique(forces[lighter]))
    return f"{part:.0%} of the path is pressed with {words} N, where {full:g} N are refused"
