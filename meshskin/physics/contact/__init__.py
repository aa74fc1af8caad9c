"""Contact models, one a file: a model is a module with a function `solve`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from ...errors import UnknownNameError
from .patch import Patch

MODELS = ("hertz", "elliptic", "layered", "field")
"""Names of the contact models, each a module of this folder."""

__all__ = ["MODELS", "Patch", "solve"]


def solve(
    model: str = "hertz",
    *,
    force: float,
    curvature: float | Sequence[float],
    indenter_radius: float,
    modulus: float,
    poisson: float,
    thickness: float | None = None,
) -> Patch:
    """The contact patch of a rigid spherical indenter pressed on a body.

    force, N; curvature: the body's principal curvatures, 1/m, positive where convex (one number
    for both equal); indenter_radius, m; modulus: the body's Young's modulus, Pa; poisson: its
    Poisson's ratio; thickness of the body's soft layer, m, None for a half-space.
    Raises UnknownNameError for an unknown model, ContactError for what leaves the model's range.
    """
    if model not in MODELS:
        raise UnknownNameError("contact model", model, MODELS)
    patch: Patch = import_module(f".{model}", __name__).solve(
        force=force,
        curvature=curvature,
        indenter_radius=indenter_radius,
        modulus=modulus,
        poisson=poisson,
        thickness=thickness,
    )
    return patch
