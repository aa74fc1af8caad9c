"""One setting of every knob that accuracy and time depend on, and the ladders of each knob."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ...contact import BATCHED
from ...estimation.calibrate import METHODS
from ...estimation.joint.newton import NEWTON_TOLERANCE
from ...geometry.body import Body

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ...scene.settings import Exploration

FACES = (1 / 16, 1 / 4, 1, 4)
STEPS = (0.5, 1.0, 2.0, 5.0)
INTEGRATORS = ("semi_implicit", "linearly_implicit", "rk4")
LANES = (0.5, 0.7, 1.0, 1.4, 2.0)
RATES = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
TOLERANCES = (1e-1, 1e-3, NEWTON_TOLERANCE)
"""Levels of the knobs; but for the tolerance they are factors on the scene's own."""


@dataclass(frozen=True)
class Setting:
    """All knobs."""

    faces: int | None
    """Faces of the body's mesh; None: the mesh is no primitive's, and stays as it is."""
    degree: int
    """Highest degree of the polynomials of the body's surface."""
    contact: str
    """Contact model."""
    dt: float
    """Step of the closed loop, s."""
    integrator: str
    lane_spacing: float
    """Between the lanes of the exploration, m."""
    rate: float
    """Frames a second."""
    method: str = "joint"
    """Estimator."""
    tolerance: float = NEWTON_TOLERANCE
    """Newton decrement at which the joint estimate rests."""

    @classmethod
    def of(cls, scene: Scene) -> Setting:
        """The scene's own."""
        return cls(
            faces=len(scene.body.mesh.faces) if scene.body.exact is not None else None,
            degree=scene.body.degree,
            contact=scene.model.name,
            dt=scene.loop.dt,
            integrator=scene.loop.integrator,
            lane_spacing=scene.exploration.lane_spacing,
            rate=scene.readout.rate,
        )

    @property
    def physics(self) -> tuple[object, ...]:
        """What the numerical error of the simulation depends on."""
        return self.faces, self.degree, self.contact, self.dt, self.integrator

    @property
    def simulated(self) -> tuple[object, ...]:
        """What the recording depends on."""
        return (*self.physics, self.lane_spacing, self.rate)

    def body(self, base: Body) -> Body:
        """The body with these faces and this degree."""
        if self.faces is not None and self.faces != len(base.mesh.faces):
            base = base.remeshed(self.faces)
        return base if base.degree == self.degree else replace(base, degree=self.degree)

    def scene(self, base: Scene, body: Body) -> Scene:
        """The scene with these knobs, on a body made by `body`; the skin stays where it is."""
        return base.with_(
            body=body,
            contact=self.contact,
            loop=replace(base.loop, dt=self.dt, integrator=self.integrator),
            exploration=self._exploration(base.exploration),
            readout=replace(base.readout, rate=self.rate),
        )

    def _exploration(self, base: Exploration) -> Exploration:
        """With these lanes; where contacts set their spacing, in the same proportion."""
        denser = base.lane_spacing / self.lane_spacing
        contacts = None if base.contacts is None else base.contacts * denser
        return replace(base, lane_spacing=self.lane_spacing, contacts=contacts)

    def words(self, base: Setting) -> str:
        """What differs from another setting, as keys of a scene's TOML and of calibrate."""
        parts = []
        for name, word in WORDS.items():
            if getattr(self, name) != getattr(base, name):
                parts.append(word(getattr(self, name)))
        return ", ".join(parts) or "the scene as it is"

    @property
    def whole_frames(self) -> bool:
        """Whether frames fall on steps."""
        steps = 1.0 / (self.rate * self.dt)
        return steps > 0.999 and abs(steps - round(steps)) < 1e-6


WORDS: dict[str, Callable[[Any], str]] = {
    "faces": lambda v: f"{v} faces",
    "degree": lambda v: f"surface degree {v}",
    "contact": lambda v: f"contact {v}",
    "dt": lambda v: f"dt {1e3 * v:g} ms",
    "integrator": lambda v: str(v),
    "lane_spacing": lambda v: f"lanes {1e3 * v:.3g} mm",
    "rate": lambda v: f"{v:g} frames/s",
    "method": lambda v: str(v),
    "tolerance": lambda v: f"tolerance {v:g}",
}
"""Knob -> how one of its levels is said."""


def reference(base: Setting, scene: Scene, finer: int = 4) -> Setting:
    """The finest setting of what the numerical error depends on."""
    return replace(
        base,
        faces=None if base.faces is None else finer * base.faces,
        degree=4,
        contact="elliptic" if scene.material.thickness is None else "layered",
        dt=base.dt / finer,
        integrator="rk4",
        tolerance=1e-12,
    )


def ladders(base: Setting, scene: Scene) -> Iterator[tuple[str, Setting]]:
    """Every knob's levels, one knob turned at a time, by (knob, setting)."""
    yield "scene", base
    if base.faces is not None:
        for factor in FACES:
            yield "faces", replace(base, faces=round(base.faces * factor))
    for degree in (2, 3, 4):
        yield "degree", replace(base, degree=degree)
    for contact in BATCHED:
        yield "contact", replace(base, contact=contact)
    others = INTEGRATORS if scene.loop.mode == "arm" else ()
    for integrator in dict.fromkeys((base.integrator, *others)):
        for factor in STEPS:
            knob = "dt" if integrator == base.integrator else "integrator"
            yield knob, replace(base, integrator=integrator, dt=base.dt * factor)
    for factor in LANES:
        yield "lanes", replace(base, lane_spacing=base.lane_spacing * factor)
    for factor in RATES:
        yield "rate", replace(base, rate=base.rate * factor)
    for method in METHODS:
        yield "method", replace(base, method=method)
    for tolerance in TOLERANCES:
        yield "tolerance", replace(base, tolerance=tolerance)
