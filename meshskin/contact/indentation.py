"""The indenter pressed on a material: the patch at a place, and why a contact model has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.errors import ContactError
from ..core.se3 import Array
from . import BATCHED, Model, Patch, solve
from .material import Material


@dataclass(frozen=True)
class Indentation:
    """A rigid spherical indenter pressed on a material under one force.

    Contact models are given by name, of physics.contact.BATCHED.
    """

    force: float
    """N."""
    indenter_radius: float
    """m."""
    material: Material

    def model(self, name: str) -> Model:
        """A contact model of this material. Raises UnknownNameError."""
        return Model(name, self.material.poisson, self.material.thickness)

    def patch(self, name: str, curvature: Array) -> Patch:
        """The patch at principal curvatures (2,), 1/m. Raises ContactError where there is none."""
        return solve(
            name,
            force=self.force,
            curvature=tuple(curvature),
            indenter_radius=self.indenter_radius,
            modulus=self.material.young,
            poisson=self.material.poisson,
            thickness=self.material.thickness,
        )

    def refusals(self, name: str, curvature: Array) -> Array:
        """Why a model does not hold (k,) at principal curvatures (k, 2), 1/m: strings, "" where it
        does.
        """
        holds = self.model(name).holds(
            force=self.force,
            curvature=curvature,
            indenter_radius=self.indenter_radius,
            effective_modulus=self.material.effective_modulus,
        )
        why, rows = np.full(len(curvature), "", dtype=object), np.flatnonzero(~holds)
        pairs, inverse = np.unique(np.round(curvature[rows], 2), axis=0, return_inverse=True)
        for k, pair in enumerate(pairs):
            try:
                self.patch(name, pair)
            except ContactError as error:
                why[rows[inverse.ravel() == k]] = f"{name} contact does not hold: {error.what}"
        return why

    def first_to_hold(self, curvature: Array) -> str:
        """The first model that holds at all of (k, 2) principal curvatures, 1/m, where any does."""
        good = [int(np.sum(self.refusals(name, curvature) == "")) for name in BATCHED]
        return BATCHED[int(np.argmax(good))]
