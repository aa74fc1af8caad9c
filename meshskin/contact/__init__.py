"""Contact models of a rigid sphere on an elastic body.

In the order of `MODELS`, each model covers what the one before it cannot: circular patches,
elliptic patches, thin layers, any gap. The models in `BATCHED` have closed forms or tables:
`ContactModel` evaluates them for many contacts at once, also as CasADi expressions. `solve` solves
one contact and checks that it lies in the range of the model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arguments import check_name
from ..core.arrays import Array
from ..core.errors import ContactError
from .patch import Patch, Patches
from .problem import (
    HOLLOW,
    MAX_LAYER_RATIO,
    MAX_WIDTH,
    NOT_FINITE,
    THIN,
    UNEQUAL,
    WIDE,
    ContactProblem,
    check_ratio,
    width_ratio,
)

MODELS = ("hertz", "elliptic", "layered", "field")
"""Names of the contact models; all but "field" (module boundary_elements) are modules here."""
BATCHED = MODELS[:3]
"""Names of the models of ContactModel."""
AUTO = "auto"
"""In a scene or a belief, instead of a name: the first model of BATCHED that is valid."""
LEARNED = "learned"
"""In a belief, instead of a name: a response that is estimated with the taxels."""

__all__ = [
    "AUTO", "BATCHED", "LEARNED", "MODELS", "ContactModel", "ContactProblem", "Patch", "Patches",
    "solve",
]  # fmt: skip


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

    model: one of MODELS; force, N; curvature: principal curvatures of the body, 1/m, positive where
    convex (one number for both equal); indenter_radius, m; modulus: Young's modulus of the body,
    Pa; poisson: its Poisson's ratio; thickness of its soft layer, m, None for a half-space;
    upgrade: where the contact is out of range of the model, the next one in MODELS is tried. The
    attribute `.model` of the patch is the name of the model used.

    Raises UnknownNameError for an unknown model, ContactError for a contact out of range of the
    model (with `upgrade`, of all models from it on).

    >>> patch = ms.contact.solve(
    ...     force=3.0, curvature=10.0, indenter_radius=0.01, modulus=0.2e6, poisson=0.49
    ... )
    >>> patch.semi_axes.round(5), round(patch.peak), round(patch.depth, 5)
    (array([0.00427, 0.00427]), 78654, 0.002)
    """
    check_name("contact model", model, MODELS)
    problem = ContactProblem(force, curvature, indenter_radius, modulus, poisson, thickness)
    names = MODELS[MODELS.index(model) :] if upgrade else (model,)
    for name in names[:-1]:
        try:
            return _solve(name, problem)
        except ContactError:
            continue
    return _solve(names[-1], problem)


def _solve(name: str, problem: ContactProblem) -> Patch:
    """The patch of one model, in its range. Raises ContactError."""
    if name == "field":
        from . import boundary_elements

        return boundary_elements.solve(problem)
    check_ratio(problem.curvature_ratio, _module(name).MAX_CURVATURE_RATIO, name)
    found = ContactModel(name, problem.poisson, problem.thickness).patches(
        force=problem.force,
        curvature=problem.curvature_pair,
        indenter_radius=problem.indenter_radius,
        effective_modulus=problem.effective_modulus,
    )
    axes = np.sort([found.first, found.second])[::-1]
    problem.check_width(axes, name)
    if name != "layered":
        problem.check_thickness(axes, name)
    return Patch(axes, float(found.peak), float(found.depth), name, float(found.exponent))


@dataclass(frozen=True)
class ContactModel:
    """A contact model of BATCHED and the soft layer that it is applied to.

    The methods accept NumPy arrays, or CasADi expressions with a column of two curvatures.
    """

    name: str = "hertz"
    """One of BATCHED."""
    poisson: float = 0.49
    """Poisson's ratio; only `layered` uses it."""
    thickness: float | None = None
    """Thickness of the soft layer, m, None for a half-space; `patches` of `layered` and `is_valid`
    use it."""

    def __post_init__(self) -> None:
        check_name("contact model", self.name, BATCHED)

    def patches(
        self, *, force: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Patches:
        """Patches under `force` (...), N, at `curvature` (..., 2), 1/m; effective_modulus: E*, Pa.

        `hertz` uses the mean curvature. Raises ContactError for NumPy values outside the series or
        the table of the model; its physical limits are those of `is_valid`.
        """
        found: Patches = self._law.patches(force, curvature, indenter_radius, effective_modulus)
        return found

    def force(
        self, *, depth: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Any:
        """Force, N, from the approach `depth` (...), m; other arguments and errors as in `patches`.

        Zero, with finite derivatives, where depth <= 0.
        """
        return self._law.force(depth, *self._shape(curvature, indenter_radius), effective_modulus)

    def slope(
        self, *, depth: Any, curvature: Any, indenter_radius: Any, effective_modulus: Any
    ) -> Any:
        """dF/d(depth), N/m, at depths > 0; other arguments and errors as in `force`.

        For `layered`, of CasADi expressions only.
        """
        shape = self._shape(curvature, indenter_radius)
        if self.name != "layered":
            return self._law.slope(depth, *shape, effective_modulus)
        import casadi as ca

        x = ca.SX.sym("depth")
        force = self._law.force(x, *shape, effective_modulus)
        return ca.substitute(ca.gradient(force, x), x, depth)

    def is_valid(
        self,
        *,
        force: float | Array,
        curvature: Array,
        indenter_radius: float,
        effective_modulus: float,
    ) -> NDArray[np.bool_]:
        """Whether contacts (k,) are in the range of the model; arguments as in
        `exceeded_limits`."""
        limits = self.exceeded_limits(force, curvature, indenter_radius, effective_modulus)
        return np.asarray(limits == "", dtype=bool)

    def exceeded_limits(
        self,
        force: float | Array,
        curvature: Array,
        indenter_radius: float,
        effective_modulus: float,
    ) -> NDArray[np.object_]:
        """The limit of the model (k,) that contacts at `curvature` (k, 2), 1/m, exceed, in words;
        "" for those in its range.

        `force` is a number or (k,); other arguments as in `patches`. `solve` raises an error that
        begins with these words exactly where there are some.
        """
        pairs = np.sort(np.asarray(curvature, dtype=float), axis=1)
        force = np.broadcast_to(np.asarray(force, dtype=float), len(pairs))
        relative = pairs + 1 / indenter_radius
        even = relative[:, 1] <= _module(self.name).MAX_CURVATURE_RATIO * relative[:, 0]
        beyond = (~np.isfinite(pairs).all(axis=1), ~(relative[:, 0] > 0), ~even)
        words = (NOT_FINITE, HOLLOW, UNEQUAL.format(self.name))
        limits = np.select(beyond, words, "").astype(object)
        rows = np.flatnonzero(limits == "")
        try:
            law = self._law
        except ContactError as error:  # a layer outside the table
            limits[rows] = error.what
            return limits
        given = indenter_radius, effective_modulus
        if self.name == "layered":
            thin = ~(law.chi(force[rows], pairs[rows], *given) <= _module(self.name).MAX_CHI)
            limits[rows[thin]] = _module(self.name).TOO_THIN
            rows = rows[~thin]
        found = law.patches(force[rows], pairs[rows], *given)
        axes = np.stack([found.first, found.second], axis=1)
        wide = ~(width_ratio(axes, pairs[rows], indenter_radius) <= MAX_WIDTH)
        limits[rows[wide]] = WIDE.format(self.name)
        if self.thickness is not None and self.name != "layered":
            thin = axes.max(axis=1) > MAX_LAYER_RATIO * self.thickness
            limits[rows[thin & ~wide]] = THIN.format(self.name)
        return limits

    @property
    def _law(self) -> Any:
        """The functions patches, force and slope: a module, or a layer."""
        if self.name != "layered":
            return _module(self.name)
        thickness = math.inf if self.thickness is None else self.thickness
        return _module(self.name).BondedLayer(self.poisson, thickness)

    def _shape(self, curvature: Any, indenter_radius: Any) -> tuple[Any, ...]:
        """The geometry as force and slope take it: `hertz` takes the relative radius, m."""
        if self.name == "hertz":
            return (self._law.relative_radius(curvature, indenter_radius),)
        return curvature, indenter_radius


def _module(name: str) -> Any:
    return import_module(f".{name}", __name__)
