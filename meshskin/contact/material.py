"""The elastic material of the skin, and its indentation."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ContactError
from . import BATCHED, ContactModel, Patch, solve
from .problem import effective_modulus

LIGHTER = 0.5, 0.25, 0.125
"""Forces, relative to a scene's, that are tried in turn where it is refused. Of the surface of the
iCub's forearm and sole on which an indenter of 8 mm fits, in a skin of 4 mm, 3 N reach 65 and 70 %,
with a half, too, 79 and 77 %, with a quarter 87 and 81 %, with an eighth 92 and 84 %; a sixteenth
adds 1 %."""


@dataclass(frozen=True)
class Material:
    """A homogeneous, isotropic, linearly elastic material, pressed by a rigid indenter.

    >>> round(ms.Material(young=0.2e6, poisson=0.49).effective_modulus)  # E / (1 - nu^2), Pa
    263193
    """

    young: float = quantity("Pa", 0.2e6, above=0.0, most=1e12)
    """Young's modulus."""
    poisson: float = quantity("", 0.49, least=0.0, most=0.5)
    """Poisson's ratio."""
    thickness: float | None = quantity("m", None, above=0.0)
    """Thickness of the soft layer; None for a layer much thicker than the patch is wide."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def effective_modulus(self) -> float:
        """E* = E / (1 - nu^2) against a rigid indenter, Pa."""
        return float(effective_modulus(self.young, self.poisson))


@dataclass(frozen=True)
class Indentation:
    """A rigid spherical indenter pressed on a material under one force."""

    force: float
    """Contact force, N."""
    indenter_radius: float
    """Radius of the indenter, m."""
    material: Material

    def model(self, name: str) -> ContactModel:
        """A contact model, one of BATCHED, of this material. Raises UnknownNameError."""
        return ContactModel(name, self.material.poisson, self.material.thickness)

    def patch(self, name: str, curvature: Array) -> Patch:
        """The patch by the model `name` at principal curvatures (2,), 1/m.

        Raises ContactError where the contact is out of range of the model.
        """
        return solve(
            name,
            force=self.force,
            curvature=tuple(curvature),
            indenter_radius=self.indenter_radius,
            modulus=self.material.young,
            poisson=self.material.poisson,
            thickness=self.material.thickness,
        )

    def first_patch(self, name: str, curvature: Array) -> Patch:
        """The patch at the first of principal curvatures (k, 2), 1/m, at which the model `name` is
        valid. Raises ContactError, of the first one, where it is valid at none.
        """
        good = np.flatnonzero(self.invalid_reasons(name, curvature) == "")
        return self.patch(name, curvature[good[0] if len(good) else 0])

    def lighter_patch(self, name: str, curvature: Array) -> Patch:
        """`first_patch` under the force, or under the first of its LIGHTER parts under which there
        is one. Raises the ContactError of the force itself where no part of it has a patch.
        """
        for part in (1.0, *LIGHTER):
            with suppress(ContactError):
                return replace(self, force=part * self.force).first_patch(name, curvature)
        return self.first_patch(name, curvature)

    def invalid_reasons(self, name: str, curvature: Array) -> Array:
        """Why the model `name` is not valid (k,) at principal curvatures (k, 2), 1/m.

        Strings, "" where it is valid.
        """
        limits = self.model(name).exceeded_limits(
            self.force, curvature, self.indenter_radius, self.material.effective_modulus
        )
        return np.where(limits == "", "", f"{name} contact does not hold: " + limits)

    def first_valid_model(self, curvature: Array) -> str:
        """The first of BATCHED that is valid at as many of (k, 2) curvatures, 1/m, as any is.

        Where none is valid, the most general one, whose reasons no other model removes.
        """
        counts = [int(np.sum(self.invalid_reasons(name, curvature) == "")) for name in BATCHED]
        if not any(counts):
            return "elliptic" if self.material.thickness is None else "layered"
        return BATCHED[int(np.argmax(counts))]
