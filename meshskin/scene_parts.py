"""How a scene is read and how its closed loop is run."""

from __future__ import annotations

from dataclasses import dataclass

from .config import check, quantity
from .errors import ConfigError
from .motion.loop import COMPILE, INTEGRATORS, MODES, known


@dataclass(frozen=True)
class Readout:
    """How the skin is read."""

    rate: float = quantity("Hz", 100.0, above=0.0, most=1e5)
    """Frames a second."""
    threshold_relative: float = quantity("", 0.0, least=0.0, most=1.0)
    """Pressures up to this part of the peak pressure at the reference force are not reported."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Loop:
    """How the closed loop is integrated."""

    dt: float = quantity("s", 1e-3, above=0.0, most=0.01)
    """Step of the integration."""
    integrator: str = "semi_implicit"
    """"semi_implicit", "linearly_implicit" (stiff contact, high gains), "rk4" (accurate where the
    contact is soft) or "cvodes" (the slow reference)."""
    mode: str = "arm"
    """"arm": with the arm's dynamics; "quasi_static": the body moves as the law asks."""
    delay: float = quantity("s", 0.0, least=0.0, most=0.1)
    """Age of the reading of the contact that the law hears: a whole number of steps."""
    compile: str = "auto"
    """The step through the C compiler: "always", "never", or "auto", where a long run pays for it
    or the machine code is in the cache."""

    def __post_init__(self) -> None:
        check(self)
        known("integrator", self.integrator, INTEGRATORS)
        known("mode of the closed loop", self.mode, MODES)
        known("choice of loop.compile", self.compile, COMPILE)
        if abs(self.delay_steps * self.dt - self.delay) > 1e-6 * self.dt:
            raise ConfigError(
                "loop.delay is no whole number of steps",
                value=f"{1e3 * self.delay:g} ms",
                limit=f"steps of {1e3 * self.dt:g} ms",
                remedy=f"set loop.delay_ms = {1e3 * self.delay_steps * self.dt:g}",
            )

    @property
    def delay_steps(self) -> int:
        """Age of the readings in steps."""
        return round(self.delay / self.dt)
