"""Settings of a scene: the compliance law, the exploration, the readout and the closed loop.

Every field with a unit is in SI units here; a scene file appends the unit to the key (`dt_ms = 1`).
"""

from __future__ import annotations

from dataclasses import dataclass

from ..core.arguments import check_name
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError

TORQUES = ("compensated", "paper", "off")
SHAPES = ("inertia", "identity")
SURFACES = ("sphere", "exact")
PATTERNS = ("auto", "parallels", "lanes")
INTEGRATORS = ("semi_implicit", "linearly_implicit", "rk4", "cvodes")
MODES = ("arm", "quasi_static")
COMPILE = ("auto", "always", "never")


@dataclass(frozen=True)
class Law:
    """Gains of the compliance law (the paper's equations 2 to 11)."""

    force_reference: float = quantity("N", 3.0, above=0.0)
    """Contact force to hold."""
    gamma: float = quantity("1/s", 50.0, above=0.0)
    """Rate at which the force error decays."""
    shape: str = "inertia"
    """Velocity gain matrix L: "inertia" (rate times mass matrix) or "identity" (gain times I)."""
    rate: float = quantity("1/s", 200.0, above=0.0)
    """Velocity gain with shape "inertia": L = rate M(q)."""
    gain: float = quantity("", 100.0, above=0.0)
    """Velocity gain with shape "identity": L = gain I, in N m s/rad."""
    torque: str = "compensated"
    """"paper": equation 11 as printed, which leaves a steady force error; "compensated": with the
    term -J^T f_c, which removes it; "off": no torque, the arm falls."""
    surface: str = "sphere"
    """Shape of the body in the law's force part: "sphere", of the mean curvature at the contact
    (the paper's law there), or "exact", with both curvatures, by automatic differentiation
    (slower)."""
    approach_speed: float = quantity("m/s", 0.1, above=0.0, most=1.0)
    """Largest speed along the normal that the force part asks for; the speed before touch."""
    tracking: float = quantity("1/s", 20.0, least=0.0)
    """Rate at which errors of the body's pose along the path decay."""
    effective_modulus: float | None = quantity("Pa", None, above=0.0)
    """E* that the law assumes of the contact; None: the true one."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_name("torque law", self.torque, TORQUES)
        check_name("surface of the law", self.surface, SURFACES)
        check_name("shape of the velocity gain", self.shape, SHAPES)


@dataclass(frozen=True)
class Exploration:
    """How the contact point covers the skin."""

    pattern: str = "auto"
    """"parallels": about the skin's axis, for convex caps; "lanes": geodesic lanes, for any region;
    "auto": parallels where the skin is a cap of a sphere that the arm can turn, and that no other
    part of the body is above or beside, else lanes."""
    lane_spacing: float = quantity("m", 3.5e-3, above=0.0)
    """Distance between lanes along the surface."""
    contacts: float | None = quantity("", None, above=0.0)
    """Wanted number of contacts per taxel; sets the spacing of geodesic lanes in place of
    `lane_spacing`."""
    margin: float = quantity("m", 3e-3, least=0.0)
    """How far the lanes extend beyond the outermost taxel."""
    speed: float = quantity("m/s", 0.05, above=0.0, most=0.5)
    """Largest speed of the contact point."""
    turn_rate: float = quantity("rad/s", 2.5, above=0.0)
    """Largest angular speed of the body."""
    joint_share: float = quantity("", 0.8, above=0.0, most=1.0)
    """Fraction of the joints' speed limits that geodesic lanes use."""
    ramp: float = quantity("s", 0.1, above=0.0)
    """Time of acceleration and of deceleration on each lane."""
    standoff: float = quantity("m", 5e-3, above=0.0)
    """Gap between body and indenter before the approach."""
    approach_ramp: float = quantity("s", 0.0, least=0.0)
    """Time in which the approach reaches its speed; 0: at once, by a jump of the torques."""
    settle: float = quantity("s", 0.3, least=0.0)
    """Rest after the touch, before the contact point moves."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_name("pattern of the exploration", self.pattern, PATTERNS)


@dataclass(frozen=True)
class Readout:
    """How the skin is read."""

    rate: float = quantity("Hz", 100.0, above=0.0, most=1e5)
    """Frame rate."""
    threshold_relative: float = quantity("", 0.0, least=0.0, most=1.0)
    """Pressure up to which readings are not recorded, relative to the peak pressure at the
    reference force."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Loop:
    """How the closed loop is integrated."""

    mode: str = "arm"
    """"arm": with the arm's dynamics; "quasi_static": the body moves exactly as the law asks."""
    dt: float = quantity("s", 1e-3, above=0.0, most=0.01)
    """Step of the integration."""
    integrator: str = "semi_implicit"
    """"semi_implicit", "linearly_implicit" (stiff contact, high gains), "rk4" (accurate where the
    contact is soft) or "cvodes" (the slow reference)."""
    delay: float = quantity("s", 0.0, least=0.0, most=0.1)
    """Age of the contact reading that the law gets: a whole number of steps."""
    compile: str = "auto"
    """Whether the step is compiled as C: "always", "never", or "auto", if the run is long enough to
    repay it or the machine code is in the cache."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_name("integrator", self.integrator, INTEGRATORS)
        check_name("mode of the closed loop", self.mode, MODES)
        check_name("choice of loop.compile", self.compile, COMPILE)
        if abs(self.delay_steps * self.dt - self.delay) > 1e-6 * self.dt:
            raise ConfigError(
                "loop.delay must be a whole number of steps",
                value=f"{1e3 * self.delay:g} ms",
                limit=f"multiples of {1e3 * self.dt:g} ms",
                remedy=f"set loop.delay_ms = {1e3 * self.delay_steps * self.dt:g}",
            )

    @property
    def delay_steps(self) -> int:
        """Age of the readings in steps."""
        return round(self.delay / self.dt)
