"""The earlier map: places of the taxels with their uncertainty, the units that may change as one,
and the turns by which a rigid module looks the same."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core import se3
from ...core.arguments import check_real
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...core.value import Value
from ...scene.belief import Belief
from ...skin import slots
from ...skin.skin import Skin
from ..calibration import Calibration
from ..data.global_parameters import IN_GROUP

SIGMA = 0.3e-3
"""Standard deviation, m, of a taxel's place along each tangent in a map that states none. Chosen:
how well a module is glued by hand onto its marks."""
MAX_TURNS = 6
"""Highest order of rotational symmetry that a layout is tested for: hexagons."""
TILT = np.pi / 180
"""Standard deviation, rad, of a taxel's tilt in such a map."""
PER_TAXEL = (
    "ids", "poses", "covariances", "observed", "touched", "readings", "chi2", "reasons", "faults",
    "rivals",
)  # fmt: skip
"""Fields of `Calibration` with a row a taxel, which an updated map keeps; None where it has none.
"""
SAME_SLOT = 1e-3
"""Largest distance, m, of a turned slot from the one at its place: a fraction of any spacing."""


@dataclass(frozen=True, eq=False)
class SkinMap(Value):
    """n taxels of an earlier map, in units that change as one: rigid modules, or single taxels."""

    calibration: Calibration
    """The earlier map, with rising ids."""
    poses: Array
    """T_body_taxel (n, 4, 4), in modules those of missing taxels too; NaN where there is no place.
    """
    covariance: Array
    """Covariance (n, 3, 3) of the positions, body frame, m^2."""
    log_gain: Array
    """ln of the factor of each taxel's level, and its standard deviation (n, 2)."""
    offset: Array
    """Offset of each taxel's readings in their unit, and its standard deviation (n, 2)."""
    units: tuple[np.ndarray, ...]
    """Rows of the taxels of each unit, those without a place left out."""
    numbers: np.ndarray
    """Number (u,) of each unit: of the module, or the id of the taxel."""
    slots: Array | None
    """Places (s, 3) of a module's taxels in its frame, m; None: units are single taxels."""

    @property
    def ids(self) -> np.ndarray:
        """Taxel ids (n,), rising."""
        return self.calibration.ids

    @property
    def noun(self) -> str:
        """What a unit is: "module" or "taxel"."""
        return "taxel" if self.slots is None else "module"

    @property
    def points(self) -> Array:
        """Positions (n, 3), m."""
        return np.asarray(self.poses[:, :3, 3])

    @property
    def known(self) -> np.ndarray:
        """Whether the map has a place (n,) bool."""
        return np.isfinite(self.points[:, 0])

    def slot(self, rows: np.ndarray) -> np.ndarray:
        """Slots of the taxels `rows` in their modules."""
        return np.asarray(self.ids[rows] % (1 if self.slots is None else len(self.slots)))


def skin_map(previous: Calibration | Skin, belief: Belief, sigma: float = SIGMA) -> SkinMap:
    """The map of an earlier calibration, or of a skin with standard deviation `sigma`, m.

    Taxels are grouped by the belief's modules, or by those of iCub where the ids are theirs. A
    taxel of a module without a place gets that of its slot, where three others have one. Raises
    CalibrationError for another type and for a map of less than one taxel.
    """
    check_real("sigma of the earlier map", sigma, "m", above=0.0, error=CalibrationError)
    base = _by_rising_ids(_of_skin(previous, sigma) if isinstance(previous, Skin) else previous)
    ids, poses = base.ids, np.array(base.poses, dtype=float)
    own = np.nan_to_num(base.covariances[:, :3, :3], posinf=sigma**2)
    covariance = poses[:, :3, :3] @ own @ np.swapaxes(poses[:, :3, :3], 1, 2)
    none = np.zeros((len(ids), 2))
    log_gain, offset = (
        np.nan_to_num(base.taxel_unknowns.get(name, none), posinf=0.0)
        for name in ("gain", "offset")
    )
    log_gain = amplification(base)[:, None] * log_gain
    known = np.isfinite(poses[:, 0, 3])
    if not known.any():
        raise CalibrationError("the earlier map has no taxel with a place")
    layout = belief.module_slots
    if layout is None and slots.is_modular(ids):
        layout = slots.OFFSETS
    if layout is None:
        rows = np.flatnonzero(known)
        units, numbers = tuple(rows[:, None]), ids[rows]
        return SkinMap(base, poses, covariance, log_gain, offset, units, numbers, None)
    numbers, group = np.unique(ids // len(layout), return_inverse=True)
    places = layout[ids % len(layout)]
    for k in range(len(numbers)):
        lost, others = (np.flatnonzero((group == k) & mask) for mask in (~known, known))
        if len(lost) and len(others) >= 3:
            pose = se3.align(places[others], poses[others, :3, 3])
            poses[lost] = pose @ se3.transform(np.eye(3), places[lost])
            covariance[lost] = np.eye(3) * sigma**2
    placed = np.isfinite(poses[:, 0, 3])
    full = np.unique(group[placed])
    units, numbers = tuple(np.flatnonzero(placed & (group == k)) for k in full), numbers[full]
    return SkinMap(base, poses, covariance, log_gain, offset, units, numbers, np.asarray(layout))


def _of_skin(skin: Skin, sigma: float) -> Calibration:
    """A skin as a calibration without readings; `sigma`, m, where it states none."""
    n, six = len(skin.ids), np.zeros((len(skin.ids), 6, 6))
    spread = np.full(n, np.nan) if skin.sigmas is None else skin.sigmas / np.sqrt(2.0)
    spread = np.where(np.isfinite(spread), spread, sigma)  # skins state two tangents together
    six[:, :3, :3] = np.eye(3) * spread[:, None, None] ** 2
    six[:, 3, 3] = six[:, 4, 4] = TILT**2
    six[:, 5, 5] = np.inf
    return Calibration(
        ids=skin.ids, poses=skin.poses, covariances=six,
        observed=np.isfinite(np.diagonal(six, axis1=1, axis2=2)), touched=np.zeros(n, dtype=bool),
        readings=np.zeros(n, dtype=int), method="recalibrate", anchor="the earlier map",
        factors=(), chi2=np.full(n, np.nan), reasons=np.full(n, "", dtype=object),
    )  # fmt: skip


def _by_rising_ids(found: Calibration) -> Calibration:
    """The calibration with its taxels in the order of their ids. Raises CalibrationError."""
    if not isinstance(found, Calibration):
        raise CalibrationError(
            "the earlier map must be a Calibration or a Skin", value=type(found).__name__
        )
    order, additions = np.argsort(found.ids, kind="stable"), found.additions
    if additions is not None:
        additions = additions.copy()
        additions[:, 1] = np.argsort(order)[additions[:, 1].astype(int)]
    columns = {name: getattr(found, name) for name in PER_TAXEL}
    return replace(
        found,
        **{name: values[order] for name, values in columns.items() if values is not None},
        taxel_unknowns={name: values[order] for name, values in found.taxel_unknowns.items()},
        additions=additions,
    )


def amplification(previous: Calibration) -> Array:
    """What ln gain (n,) is multiplied by in the level of a reading: a gain is that of readings of
    the typical level, which compression makes smaller (joint/likelihood.py)."""
    factor = np.ones(len(previous.ids))
    for group, response in enumerate(() if previous.response is None else previous.response.each):
        name = "compression" + (IN_GROUP.format(group + 1) if group else "")
        compression = previous.unknowns.get(name, (0.0, 0.0))[0]
        own = np.isin(previous.ids, response.taxels) | (group == 0)
        factor[own] = 1 + response.levels[0] * compression
    return factor


def turns(layout: Array, used: np.ndarray) -> dict[float, np.ndarray]:
    """Turns about the normal, rad, that put the slots `used` of a layout (s, 3), m, onto each
    other, and the slot (s,) at whose place each one then is.
    """
    centre, found = layout[used].mean(axis=0), {}
    for order in range(2, MAX_TURNS + 1):
        for k in range(1, order):
            angle = 2 * np.pi * k / order
            turned = (layout[used] - centre) @ se3.exp_so3([0.0, 0.0, angle]).T + centre
            gap = np.linalg.norm(turned[:, None] - layout[used], axis=2)
            partner = gap.argmin(axis=1)
            if gap.min(axis=1).max() < SAME_SLOT and len(np.unique(partner)) == len(used):
                image = np.arange(len(layout))
                image[used] = used[partner]
                found[round(angle, 9)] = image
    return found
