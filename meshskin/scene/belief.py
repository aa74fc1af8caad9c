"""The belief: what calibration may use besides the recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..contact import AUTO, BATCHED, LEARNED
from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import (
    NamedFields,
    check_array,
    check_name,
    check_real,
    check_type,
    replace_fields,
    repr_short,
)
from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError, SkinError
from ..core.value import Value
from ..geometry.body import Body
from ..skin import slots
from ..skin.skin import Modules, Skin
from .contact_motion import ContactMotion

MODULE_TOLERANCE = 1e-5
"""Largest deviation of a taxel from its slot in a rigid module, m: below the position error of an
estimate (0.08 mm with 5 % noise), above the rounding of skin files (0.001 mm)."""
PRESSURE, RAW = READINGS = ("pressure", "raw")
"""Units of the readings of a belief."""


@dataclass(frozen=True, eq=False)
class Belief(Value, NamedFields):
    """What the robot's owner knows: all that calibration may use besides the recording.

    Raises ConfigError for an unknown field or a value out of range.
    """

    body: Body
    """The body, as the owner knows it."""
    indenter: Indenter
    """The indenter, as the owner knows it."""
    material: Material
    """Nominal material; the joint estimator estimates E* with the taxels."""
    taxel_ids: np.ndarray
    """Ids (n,) of all taxels of the skin; none: those that the recording names."""
    disc_radius: float = quantity("m", 2e-3, above=0.0, most=0.05)
    """Radius of a taxel's disc, m."""
    contact: str = AUTO
    """Contact model, one of contact.BATCHED; "auto": the first of them that holds in the
    recording's contacts, or a learned response where the readings contradict it; "learned": a
    response that is estimated with the taxels, with a contact model as its mean."""
    force_reference: float | None = quantity("N", None, above=0.0)
    """Typical contact force, N; None: the median of the recording's."""
    noise_sigma: float | None = quantity("Pa", None, above=0.0)
    """Standard deviation of a reading's noise, Pa; None: unknown, estimated from the residuals."""
    threshold: float = quantity("Pa", 0.0, least=0.0)
    """Pressure up to which readings are not recorded, Pa."""
    saturation: float | None = quantity("Pa", None, above=0.0)
    """Upper end of the sensors' range, Pa; readings at or above it are censored. None: the range
    has no end."""
    readings: str = PRESSURE
    """Unit of the readings: "pressure", Pa, or "raw": counts or volts of any scale and polarity,
    in which noise_sigma, threshold and saturation are stated, too; the response is learned then."""
    unknown: tuple[str, ...] = ("modulus",)
    """What is estimated besides the taxels: any of "modulus" (E*), "gain", "offset" and "drift" of
    the offset (of each taxel), "force_scale", "force_offset", "indenter_offset" (3), "body_offset"
    (6), "drag", the distance of the patches behind the moving contacts, as of late readings,
    "friction", the shear of the skin at which contacts that stick begin to slide, and
    "patch_shift", the displacement of the patches where the curvature of the body changes, relative
    to that of a foundation of springs. Gain and offset are tried undeclared, too, for taxels that
    do not fit without them."""
    priors: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of unknowns before any data, where they are not the defaults."""
    surface_sigma: float = quantity("m", 0.0, least=0.0)
    """Standard deviation, m, of the real surface about that of `body`, where it is known: from
    dents, or from a body of another size, on which taxels are displaced along the surface, too. It
    is added to what the distances of the contact points from the body show."""
    headings: Array | None = None
    """Rotations (m, 3, 3), world from body, of the recording's m contacts; an unknown indenter
    offset needs them. None: those in the recording, if any."""
    contact_motion: ContactMotion | None = None
    """Unknowns of the robot that move the recording's m contacts; None: none of them does."""
    module_slots: Array | None = None
    """Positions (slots, 3) of a rigid module's taxels in the module's frame, m (z = outward
    normal); taxel ids are then slots * module + slot. None: the taxels are independent."""
    response_groups: tuple[np.ndarray, ...] = ()
    """Ids of the taxels of each further group that responds in its own way, such as a second skin
    or amplifier: response_groups=(range(48, 96),). Taxels of no group are the first one; where
    every taxel is in a group, the first group listed is. A learned response has a profile,
    exponents and a compression for each; a contact model has one response for all. Undeclared, two
    groups are looked for among the modules and the parts of the ids."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name, kind in {"body": Body, "indenter": Indenter, "material": Material}.items():
            check_type(kind, getattr(self, name), f"the {name} of a belief")
        check_name("contact model", self.contact, (*BATCHED, AUTO, LEARNED))
        check_name("unit of the readings", self.readings, READINGS)
        if isinstance(self.unknown, str) or not isinstance(self.unknown, Collection):
            raise ConfigError(
                "belief.unknown must be a list of names",
                value=repr_short(self.unknown),
                remedy=f'write unknown=("{self.unknown}",)',
            )
        object.__setattr__(self, "taxel_ids", _checked_ids(self.taxel_ids))
        object.__setattr__(self, "response_groups", self._checked_groups())
        check_type(Mapping, self.priors, "priors of a belief")
        for name, sigma in self.priors.items():
            check_real(f"prior of {name}", sigma, above=0.0)
        if self.contact_motion is not None:
            check_type(ContactMotion, self.contact_motion, "the contact motion of a belief")
        if self.headings is not None:
            headings = check_array("headings of a belief", self.headings)
            gram = headings @ np.swapaxes(headings, -1, -2) if headings.ndim == 3 else np.zeros(1)
            turns = headings.shape[1:] == (3, 3) and np.allclose(gram, np.eye(3), atol=1e-6)
            if not turns or np.any(np.linalg.det(headings) < 0):
                raise ConfigError(
                    "headings of a belief must be rotation matrices",
                    value=f"shape {headings.shape}",
                    limit="(m, 3, 3), orthonormal within 1e-6, without reflections",
                )

    def _checked_groups(self) -> tuple[np.ndarray, ...]:
        """Ids of the taxels of each group that has some, as integers. Raises ConfigError."""
        groups = self.response_groups
        if isinstance(groups, str) or not isinstance(groups, Collection):
            raise ConfigError(
                "belief.response_groups must be a list of lists of taxel ids",
                value=repr_short(groups),
                remedy="write response_groups=(range(48, 96),)",
            )
        found = tuple(_checked_ids(ids, "response group of a belief") for ids in groups)
        _checked_ids(np.concatenate([np.empty(0), *found]), "response groups of a belief")
        for number, ids in enumerate(found, 1):
            if not np.isin(ids, self.taxel_ids).any():
                raise ConfigError(
                    f"response group {number} of a belief has no taxel of the skin",
                    value=f"{len(ids)} ids",
                    limit=f"taxel ids {self.taxel_ids.min()} to {self.taxel_ids.max()}"
                    if len(self.taxel_ids)
                    else "no taxel ids",
                    remedy="list ids of taxel_ids",
                )
        if found and np.isin(self.taxel_ids, np.concatenate(found)).all():
            return found[1:]
        return found

    def with_(self, **changes: Any) -> Belief:
        """This belief with other values of some fields. Raises ConfigError."""
        return replace_fields(self, changes)


def _checked_ids(taxel_ids: object, what: str = "taxel ids of a belief") -> np.ndarray:
    """Taxel ids as integers (n,). Raises ConfigError."""
    ids = check_array(what, taxel_ids)  # type: ignore[arg-type]
    if ids.ndim != 1:
        raise ConfigError(f"{what} must be a list", value=f"shape {ids.shape}")
    fractional = ~np.isfinite(ids) | (ids != np.round(ids))
    if fractional.any():
        raise ConfigError(f"{what} must be whole numbers", value=f"{ids[np.argmax(fractional)]:g}")
    unique, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        raise ConfigError(
            f"{what} must be unique",
            value=f"{int(unique[np.argmax(count > 1)])} {count.max()} times",
            remedy="list every taxel once",
        )
    return ids.astype(np.int64)


def module_slots(skin: Skin) -> Array | None:
    """The slots of the data sheet where a skin consists of rigid modules; not their poses."""
    try:
        Modules.of(skin, MODULE_TOLERANCE)
    except SkinError:
        return None
    return slots.OFFSETS
