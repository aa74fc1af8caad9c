"""The earlier map with the changes that were found."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from ...core import se3
from ...core.arrays import Array
from ..calibration import Calibration
from ..chart import align_normals
from .evidence import Evidence
from .hypotheses import DEAD, EXCHANGED, GAIN, MOVED, TURNED
from .result import Finding
from .skin_map import SkinMap, amplification

if TYPE_CHECKING:
    from ...scene.belief import Belief
    from ...skin.skin import Skin

FACTOR = "earlier map, tested by {} touches: {} changes"
"""What the updated map is made of."""
UNKNOWN = "the earlier map has no place for it"


def updated(
    previous: Calibration | Skin,
    belief: Belief,
    known: SkinMap,
    found: list[Evidence],
    findings: tuple[Finding, ...],
    contacts: int,
) -> Calibration:
    """The calibration with the taxels of changed units at their new places, and faults named."""
    poses, covariance = known.poses.copy(), known.covariance.copy()
    gain, faults = known.log_gain.copy(), np.full(len(known.ids), "", dtype=object)
    for rows, evidence in zip(known.units, found, strict=True):
        for change in evidence.changes:
            h = change.hypothesis
            mine = rows if h.taxel < 0 else rows[h.taxel : h.taxel + 1]
            if h.state in (TURNED, EXCHANGED, MOVED):
                rotation = align_normals(known.poses[rows, :3, :3], h.normals)
                poses[rows] = se3.transform(rotation, evidence.state.points)
            if h.state in (TURNED, EXCHANGED):  # the places are those of other taxels of the map
                placed = np.flatnonzero(known.known)
                nearest = cKDTree(known.points[placed]).query(h.points)[1]
                covariance[rows] = known.covariance[placed[nearest]]
            if h.state == MOVED:
                covariance[rows] += change.shift_covariance
            if h.state == GAIN:
                gain[mine] += change.log_gain
            if h.state in (DEAD, GAIN):
                words = h.state if h.state == DEAD else f"gain times {np.exp(change.log_gain):.2f}"
                faults[mine] = [", ".join(filter(None, (f, words))) for f in faults[mine]]
    lost = ~known.known & ~np.isfinite(poses[:, 0, 3])
    local = np.swapaxes(poses[:, :3, :3], 1, 2) @ covariance @ poses[:, :3, :3]
    base = previous if isinstance(previous, Calibration) else None
    six = _covariances(base, known, local, lost)
    taxel_unknowns = {} if base is None else dict(base.taxel_unknowns)
    if np.any(gain != known.log_gain) or "gain" in taxel_unknowns:
        spread = np.zeros(len(gain)) if base is None or "gain" not in taxel_unknowns else (
            np.asarray(taxel_unknowns["gain"])[np.argsort(base.ids, kind="stable"), 1]
        )  # fmt: skip
        gain = gain if base is None else gain / amplification(base)
        taxel_unknowns["gain"] = np.stack([gain, spread], axis=1)
    made = FACTOR.format(contacts, len(findings))
    n = len(known.ids)
    touched = np.zeros(n, dtype=bool)
    for rows, evidence in zip(known.units, found, strict=True):
        touched[rows] = evidence.touched
    if base is None:
        return Calibration(
            ids=known.ids, poses=poses, covariances=six,
            observed=np.isfinite(np.diagonal(six, axis1=1, axis2=2)),
            touched=touched,
            readings=np.zeros(n, dtype=int), method="recalibrate", anchor="the earlier map",
            factors=(made,), chi2=np.full(n, np.nan),
            reasons=np.where(lost, UNKNOWN, "").astype(object), faults=faults,
            taxel_unknowns=taxel_unknowns, belief=replace(belief, taxel_ids=known.ids),
        )  # fmt: skip
    order = np.argsort(base.ids, kind="stable")
    old = np.full(n, "", dtype=object) if base.faults is None else base.faults[order]
    named = [", ".join(filter(None, pair)) for pair in zip(old, faults, strict=True)]
    filled = known.known & ~np.isfinite(base.positions[order, 0])
    return replace(
        base,
        ids=known.ids, poses=poses, covariances=six,
        observed=base.observed[order] | filled[:, None], touched=base.touched[order],
        readings=base.readings[order], chi2=base.chi2[order],
        reasons=np.where(filled, "", base.reasons[order]).astype(object),
        faults=np.array(named, dtype=object),
        rivals=None if base.rivals is None else base.rivals[order],
        contact_centroids=None, iterates=None, factors=(*base.factors, made),
        taxel_unknowns={k: v if k == "gain" else v[order] for k, v in taxel_unknowns.items()},
        belief=base.belief or belief,
    )  # fmt: skip


def _covariances(base: Calibration | None, known: SkinMap, local: Array, lost: np.ndarray) -> Array:
    """(n, 6, 6) in the taxels' frames: the position's part from `local` (n, 3, 3), m^2."""
    out = np.zeros((len(known.ids), 6, 6))
    if base is not None:
        out[:] = base.covariances[np.argsort(base.ids, kind="stable")]
    else:
        out[:, 3, 3] = out[:, 4, 4] = (np.pi / 180) ** 2
        out[:, 5, 5] = np.inf
    out[:, :3, :3] = local
    out[lost] = np.diag([np.inf] * 6)
    return out
