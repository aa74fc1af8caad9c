"""The skin's elastic material."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.config import check, quantity
from . import hertz


@dataclass(frozen=True)
class Material:
    """A homogeneous, isotropic, linearly elastic material, pressed by a rigid indenter."""

    young: float = quantity("Pa", 0.2e6, above=0.0, most=1e12)
    """Young's modulus."""
    poisson: float = quantity("", 0.49, least=0.0, most=0.5)
    """Poisson's ratio."""
    thickness: float | None = quantity("m", None, above=0.0)
    """Thickness of the soft layer; None for a layer much thicker than the patch is wide."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def effective_modulus(self) -> float:
        """E* = E / (1 - nu^2) against a rigid indenter, Pa."""
        return float(hertz.effective_modulus(self.young, self.poisson))
