"""Contact models, one a file, and their doors for one contact and for many.

A model is a module with a function `solve`; those in `BATCHED` also answer for many contacts at
once and as CasADi expressions, through `patches` and `force`. In the order of `MODELS` each takes
in what the one before it cannot: circles, ellipses, thin layers, any gap. `several` finds the
contacts of a sphere with a hollow body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from ...errors import ContactError, UnknownNameError
from .patch import Patch, Patches
from .setting import Setting

MODELS = ("hertz", "elliptic", "layered", "field")
"""Names of the contact models, each a module of this folder."""
BATCHED = MODELS[:3]
"""Names of the models that `patches` and `force` know."""

__all__ = ["BATCHED", "MODELS", "Patch", "Patches", "force", "patches", "solve"]


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
    case: dict[str, Any] = {
        "force": force,
        "curvature": curvature,
        "indenter_radius": indenter_radius,
        "modulus": modulus,
        "poisson": poisson,
        "thickness": thickness,
    }
    Setting(**case)  # what is no contact at all is refused here, before any model is tried
    for name in MODELS[MODELS.index(model) : -1] if upgrade else ():
        try:
            patch: Patch = _module(name).solve(**case)
        except ContactError:
            continue
        return patch
    patch = _module(MODELS[-1] if upgrade else model).solve(**case)
    return patch


def patches(
    model: str,
    *,
    force: Any,
    curvature: Any,
    indenter_radius: Any,
    effective_modulus: Any,
    poisson: float,
    thickness: float | None = None,
) -> Patches:
    """Patches of many contacts by a model of `BATCHED`.

    force (...), N; curvature (..., 2), 1/m; effective_modulus: E*, Pa; NumPy arrays, or CasADi
    expressions with a column of two curvatures. `poisson` and `thickness` matter to `layered`
    only. For `hertz` the circle of the mean curvature. Raises ContactError for NumPy values outside
    the range of the model's series (not for its physical limits: `solve` has these).
    """
    _known(model, BATCHED)
    if model == "layered":
        layer = _module(model).Layer(poisson, math.inf if thickness is None else thickness)
        found: Patches = layer.patches(force, curvature, indenter_radius, effective_modulus)
    else:
        found = _module(model).patches(force, curvature, indenter_radius, effective_modulus)
    return found


def force(
    model: str,
    *,
    depth: Any,
    curvature: Any,
    indenter_radius: Any,
    effective_modulus: Any,
    poisson: float,
    thickness: float | None = None,
) -> Any:
    """Force, N, from the approach `depth` (...), m, by a model of `BATCHED`.

    Zero, with finite derivatives, where depth <= 0. Other arguments and errors as `patches`.
    """
    _known(model, BATCHED)
    if model == "layered":
        layer = _module(model).Layer(poisson, math.inf if thickness is None else thickness)
        return layer.force(depth, curvature, indenter_radius, effective_modulus)
    if model == "elliptic":
        return _module(model).force(depth, curvature, indenter_radius, effective_modulus)
    hertz = _module(model)
    return hertz.force(depth, hertz.relative_radius(curvature, indenter_radius), effective_modulus)


def _known(model: str, names: Sequence[str]) -> None:
    if model not in names:
        raise UnknownNameError("contact model", model, names)


def _module(model: str) -> Any:
    return import_module(f".{model}", __name__)
