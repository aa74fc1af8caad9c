"""The belief: what calibration may use besides the recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..contact import AUTO, BATCHED
from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import check_type, repr_short
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError, UnknownNameError
from ..core.se3 import Array
from ..geometry.body import Body


@dataclass(frozen=True)
class Belief:
    """What the robot's owner knows: everything that calibration may use besides the recording."""

    body: Body
    indenter: Indenter
    material: Material
    """Nominal material; the joint estimator estimates E* with the taxels."""
    taxel_ids: np.ndarray
    """Ids (n,) of all taxels of the skin."""
    disc_radius: float = quantity("m", 2e-3, above=0.0, most=0.05)
    """Radius of a taxel's disc, m."""
    contact: str = "hertz"
    """Name of the contact model, or "auto": the first that holds in the recording's contacts."""
    force_reference: float | None = quantity("N", None, above=0.0)
    """Force of a usual contact, N; None: the median of the recording's."""
    noise_sigma: float | None = quantity("Pa", None, least=0.0)
    """Standard deviation of a reading's noise, Pa; None: unknown, taken from the residuals."""
    threshold: float = quantity("Pa", 0.0, least=0.0)
    """Pressures up to this are not reported, Pa."""
    saturation: float | None = quantity("Pa", None, least=0.0)
    """Readings of this and more are at the end of the sensor's range, Pa."""
    unknown: tuple[str, ...] = ("modulus",)
    """What is estimated beside the taxels: any of "modulus" (E*), "gain" and "offset" (of each
    taxel), "force_scale", "force_offset", "indenter_offset" (3), "body_offset" (6). Gain and offset
    are estimated undeclared, too, where without them taxels misfit that are none the worse."""
    priors: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of unknowns before any data, where they are not the defaults."""
    headings: Array | None = None
    """Rotations (m, 3, 3), world from body, of the recording's contacts: an unknown indenter offset
    needs them. None: those that the recording itself may hold."""
    module_slots: Array | None = None
    """Places (slots, 3) of a rigid module's taxels in the module's frame, m (z = outward normal);
    taxel ids are then slots * module + slot. None: every taxel by itself."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name, kind in {"body": Body, "indenter": Indenter, "material": Material}.items():
            check_type(kind, getattr(self, name), f"the {name} of a belief")
        if self.contact not in (*BATCHED, AUTO):
            raise UnknownNameError("contact model", str(self.contact), (*BATCHED, AUTO))
        if isinstance(self.unknown, str) or not isinstance(self.unknown, Collection):
            raise ConfigError(
                "what is unknown to a belief is a list of names",
                value=repr_short(self.unknown),
                remedy=f'write unknown=("{self.unknown}",)',
            )
