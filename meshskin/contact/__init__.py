"""Contact models, one a file, and their doors for one contact and for many.

A model is a module with a function `solve` of a `ContactProblem`; those in `BATCHED` also answer
for many contacts at once and as CasADi expressions, through `patches` and `force`. In the order of
`MODELS` each takes in what the one before it cannot: circles, ellipses, thin layers, any gap.
`multi_contact` finds the contacts of a sphere with a hollow body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ContactError, UnknownNameError
from ..core.se3 import Array
from .patch import Patch, Patches
from .problem import MAX_LAYER_RATIO, MAX_WIDTH, ContactProblem, width

MODELS = ("hertz", "elliptic", "layered", "field")
"""Names of the contact models, each a module of this folder."""
MODULES = {"field": "boundary_elements"}
"""Modules of the models that are named otherwise."""
BATCHED = MODELS[:3]
"""Names of the models that `patches` and `force` know."""
AUTO = "auto"
"""In place of a name, of a scene or a belief: the first of BATCHED that holds."""

__all__ = [
    "BATCHED",
    "MODELS",
    "ContactModel",
    "ContactProblem",
    "Patch",
    "Patches",
    "force",
    "patches",
    "solve",
]


def solve(
    model: str = "hertz",
    *,
    force: float,
    curvature: float | Sequence[float],
    indenter_radius: float,
    modulus: float,
    poisson: float,
    thickness: float | None = None,
    upgrade: bool = False,
) -> Patch:
    """The contact patch of a rigid spherical indenter pressed on a body.

    force, N; curvature: the body's principal curvatures, 1/m, positive where convex (one number
    for both equal); indenter_radius, m; modulus: the body's Young's modulus, Pa; poisson: its
    Poisson's ratio; thickness of the body's soft layer, m, None for a half-space. With `upgrade`,
    where the scene leaves the model's range the next model up takes it; `.model` of the patch
    says which one did. Raises UnknownNameError for an unknown model, ContactError for what leaves
    the range of the model (with `upgrade`, of all from it up).
    """
    _known(model, MODELS)
    # what is no contact at all is refused here, before any model is tried
    setting = ContactProblem(force, curvature, indenter_radius, modulus, poisson, thickness)
    for name in MODELS[MODELS.index(model) : -1] if upgrade else ():
        try:
            patch: Patch = _module(name).solve(setting)
        except ContactError:
            continue
        return patch
    patch = _module(MODELS[-1] if upgrade else model).solve(setting)
    return patch


@dataclass(frozen=True)
class ContactModel:
    """A batched contact model and the soft layer that it is asked about.

    Its methods take NumPy arrays, or CasADi expressions with a column of two curvatures.
    """

    name: str = "hertz"
    """One of BATCHED."""
    poisson: float = 0.49
    """Poisson's ratio; it matters to `layered` only."""
    thickness: float | None = None
    """Thickness of the soft layer, m, None for a half-space; it matters to `layered` only."""

    def __post_init__(self) -> None:
        _known(self.name, BATCHED)

    def patches(
        self, *, force: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Patches:
        """Patches under `force` (...), N, at `curvature` (..., 2), 1/m; effective_modulus: E*, Pa.

        For `hertz` the circle of the mean curvature. Raises ContactError for NumPy values outside
        the range of the model's series (not for its physical limits: `solve` has these).
        """
        found: Patches = self._law.patches(force, curvature, indenter_radius, effective_modulus)
        return found

    def force(
        self, *, depth: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Any:
        """Force, N, from the approach `depth` (...), m; other arguments and errors as `patches`.

        Zero, with finite derivatives, where depth <= 0.
        """
        if self.name == "hertz":
            radius = self._law.relative_radius(curvature, indenter_radius)
            return self._law.force(depth, radius, effective_modulus)
        return self._law.force(depth, curvature, indenter_radius, effective_modulus)

    def slope(
        self, *, depth: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Any:
        """dF/d(depth), N/m, at depths > 0; other arguments and errors as `force`.

        For `layered` of CasADi expressions only.
        """
        if self.name == "hertz":
            radius = self._law.relative_radius(curvature, indenter_radius)
            return self._law.slope(depth, radius, effective_modulus)
        if self.name == "elliptic":
            return self._law.slope(depth, curvature, indenter_radius, effective_modulus)
        import casadi as ca

        at = ca.SX.sym("depth")
        force = self._law.force(at, curvature, indenter_radius, effective_modulus)
        return ca.substitute(ca.gradient(force, at), at, depth)

    def is_valid(
        self,
        *,
        force: float | Array,
        curvature: Array,
        indenter_radius: float,
        effective_modulus: float,
    ) -> NDArray[np.bool_]:
        """Whether `solve` has a patch (k,) at `curvature` (k, 2), 1/m.

        `force` is one or (k,); other arguments as `patches`. All limits of the model, for many
        contacts at once; `solve` says which one it is that does not hold.
        """
        pairs = np.sort(np.asarray(curvature, dtype=float), axis=1)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(pairs))
        try:
            module, law = _module(self.name), self._law
        except ContactError:  # a layer that the table does not know
            return np.zeros(len(pairs), dtype=bool)
        relative = pairs + 1 / indenter_radius
        good = np.isfinite(pairs).all(axis=1) & (relative[:, 0] > 0)
        good[good] = relative[good, 1] <= module.MAX_CURVATURE_RATIO * relative[good, 0]
        if self.name == "layered":
            chi = law.chi(force[good], pairs[good], indenter_radius, effective_modulus)
            good[good] = chi <= module.MAX_CHI
        found = law.patches(force[good], pairs[good], indenter_radius, effective_modulus)
        axes = np.stack([found.first, found.second], axis=1)
        fits = width(axes, pairs[good], indenter_radius) <= MAX_WIDTH
        if self.thickness is not None and self.name != "layered":
            fits &= axes.max(axis=1) <= MAX_LAYER_RATIO * self.thickness
        good[good] = fits
        return good

    @property
    def _law(self) -> Any:
        if self.name != "layered":
            return _module(self.name)
        thickness = math.inf if self.thickness is None else self.thickness
        return _module(self.name).BondedLayer(self.poisson, thickness)


def patches(
    model: str, *, poisson: float = 0.49, thickness: float | None = None, **contact: Any
) -> Patches:
    """Patches of many contacts by a model of `BATCHED`: see `ContactModel.patches`."""
    return ContactModel(model, poisson, thickness).patches(**contact)


def force(
    model: str, *, poisson: float = 0.49, thickness: float | None = None, **contact: Any
) -> Any:
    """Force, N, from the approach, by a model of `BATCHED`: see `ContactModel.force`."""
    return ContactModel(model, poisson, thickness).force(**contact)


def _known(model: str, names: Sequence[str]) -> None:
    if model not in names:
        raise UnknownNameError("contact model", model, names)


def _module(model: str) -> Any:
    return import_module(f".{MODULES.get(model, model)}", __name__)
