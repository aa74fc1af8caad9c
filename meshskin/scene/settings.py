"""How a scene is read and how its closed loop is run."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.arguments import check_name
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError, UnknownNameError


@dataclass(frozen=True)
class Readout:
    """How the skin is read."""

    rate: float = quantity("Hz", 100.0, above=0.0, most=1e5)
    """Frames a second."""
    threshold_relative: float = quantity("", 0.0, least=0.0, most=1.0)
    """Pressures up to this part of the peak pressure at the reference force are not reported."""

    def __post_init__(self) -> None:
        check_fields(self)


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
        check_fields(self)
        check_name("integrator", self.integrator, INTEGRATORS)
        check_name("mode of the closed loop", self.mode, MODES)
        check_name("choice of loop.compile", self.compile, COMPILE)
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


PATTERNS = ("auto", "parallels", "lanes")


@dataclass(frozen=True)
class Exploration:
    """How the contact point covers the skin."""

    lane_spacing: float = quantity("m", 3.5e-3, above=0.0)
    """Distance between lanes along the surface."""
    margin: float = quantity("m", 3e-3, least=0.0)
    """How far the lanes go beyond the outermost taxel."""
    speed: float = quantity("m/s", 0.05, above=0.0, most=0.5)
    """Largest speed of the contact point."""
    turn_rate: float = quantity("rad/s", 2.5, above=0.0)
    """Largest rate of the body's rotation."""
    ramp: float = quantity("s", 0.1, above=0.0)
    """Time to speed up and to slow down, on each lane."""
    standoff: float = quantity("m", 5e-3, above=0.0)
    """Gap between body and indenter before the approach."""
    approach_ramp: float = quantity("s", 0.0, least=0.0)
    """Time in which the approach gains its speed; 0: at once, by a jerk of the torques."""
    settle: float = quantity("s", 0.3, least=0.0)
    """Rest after the touch, before the contact point moves."""
    pattern: str = "auto"
    """"parallels": about the skin's axis, for convex caps; "lanes": geodesic lanes, for any region;
    "auto": parallels where the skin is a cap of a sphere that the arm can turn, lanes elsewhere."""
    contacts: float | None = quantity("", None, above=0.0)
    """Contacts wanted of each taxel; sets the spacing of geodesic lanes in place of
    `lane_spacing`."""
    joint_share: float = quantity("", 0.8, above=0.0, most=1.0)
    """Part of the joints' speed limits that geodesic lanes use."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.pattern not in PATTERNS:
            raise UnknownNameError("pattern of the exploration", self.pattern, PATTERNS)


SURFACES = ("sphere", "exact")


TORQUES = ("compensated", "paper", "off")


SHAPES = ("inertia", "identity")


@dataclass(frozen=True)
class Law:
    """Gains of the compliance law."""

    force_reference: float = quantity("N", 3.0, above=0.0)
    """Contact force to hold."""
    gamma: float = quantity("1/s", 50.0, above=0.0)
    """Rate at which the force error decays."""
    rate: float = quantity("1/s", 200.0, above=0.0)
    """Velocity gain: L = rate M(q) with shape "inertia"."""
    shape: str = "inertia"
    """Velocity gain matrix L: "inertia" (rate times mass matrix) or "identity" (gain times I)."""
    gain: float = quantity("", 100.0, above=0.0)
    """Velocity gain with shape "identity": L = gain I, in N m s/rad."""
    torque: str = "compensated"
    """"paper": eq. 11 as printed, with its steady force error; "compensated": with -J^T f_c;
    "off": none, the arm falls."""
    surface: str = "sphere"
    """What the force part takes the body for: "sphere", of its mean curvature at the contact (the
    paper's law there), or "exact", with both curvatures, by automatic differentiation (slower)."""
    approach_speed: float = quantity("m/s", 0.1, above=0.0, most=1.0)
    """Largest speed along the normal that the force part may ask for; the speed before touch."""
    tracking: float = quantity("1/s", 20.0, least=0.0)
    """Rate at which errors of the body's pose along the path decay."""
    effective_modulus: float | None = quantity("Pa", None, above=0.0)
    """E* that the law takes the contact to have; None: the one that it has."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.torque not in TORQUES:
            raise UnknownNameError("torque law", self.torque, TORQUES)
        if self.surface not in SURFACES:
            raise UnknownNameError("surface of the law", self.surface, SURFACES)
        if self.shape not in SHAPES:
            raise UnknownNameError("shape of the velocity gain", self.shape, SHAPES)


INTEGRATORS = ("semi_implicit", "linearly_implicit", "rk4", "cvodes")


MODES = ("arm", "quasi_static")


COMPILE = ("auto", "always", "never")
