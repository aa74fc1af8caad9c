"""The elastic material of the skin, and its indentation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ContactError
from . import BATCHED, ContactModel, Patch, solve
from .problem import effective_modulus


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

    def invalid_reasons(self, name: str, curvature: Array) -> Array:
        """Why the model `name` is not valid (k,) at principal curvatures (k, 2), 1/m.

        Strings, "" where it is valid.
        """
        valid = self.model(name).is_valid(
            force=self.force,
            curvature=curvature,
            indenter_radius=self.indenter_radius,
            effective_modulus=self.material.effective_modulus,
        )
        rows = np.flatnonzero(~valid)
        reasons = np.full(len(curvature), "", dtype=object)
        pairs, inverse = np.unique(np.round(curvature[rows], 2), axis=0, return_inverse=True)
        for k, pair in enumerate(pairs):
            try:
                self.patch(name, pair)
            except ContactError as error:
                reasons[rows[inverse.ravel() == k]] = f"{name} contact does not hold: {error.what}"
        return reasons

    def first_valid_model(self, curvature: Array) -> str:
        """The first of BATCHED that is valid at as many of (k, 2) curvatures, 1/m, as any is.

        Where none is valid, the most general one, whose reasons no other model removes.
        """
        counts = [int(np.sum(self.invalid_reasons(name, curvature) == "")) for name in BATCHED]
        if not any(counts):
            return "elliptic" if self.material.thickness is None else "layered"
        return BATCHED[int(np.argmax(counts))]
