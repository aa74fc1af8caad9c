"""A setting: one value of every knob that accuracy and time depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...geometry.body import Body
from ...scene.scene import Scene


@dataclass(frozen=True)
class Setting:
    """One value of every knob."""

    faces: int | None
    """Number of faces of a primitive's mesh; None for a loaded mesh, which is not changed."""
    degree: int
    """Highest degree of the polynomials of the body's surface."""
    contact: str
    """Contact model."""
    dt: float
    """Time step of the closed loop, s."""
    integrator: str
    """Integrator of the closed loop."""
    lane_spacing: float
    """Spacing of the lanes of the exploration, m."""
    rate: float
    """Frames per second."""
    method: str = "joint"
    """Estimator."""
    tolerance: float = NEWTON_TOLERANCE
    """Newton decrement at which the joint estimate stops."""

    @classmethod
    def of(cls, scene: Scene) -> Setting:
        """The setting of a scene."""
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
        """The knobs that the numerical error of the simulation depends on."""
        return self.faces, self.degree, self.contact, self.dt, self.integrator

    @property
    def simulated(self) -> tuple[object, ...]:
        """The knobs that the recording depends on."""
        return (*self.physics, self.lane_spacing, self.rate)

    @property
    def whole_frames(self) -> bool:
        """Whether the time between frames is a whole number of steps."""
        steps = 1.0 / (self.rate * self.dt)
        return steps > 0.999 and abs(steps - round(steps)) < 1e-6

    def body(self, base: Body) -> Body:
        """The body with the faces and the degree of this setting."""
        if self.faces is not None and self.faces != len(base.mesh.faces):
            base = base.remeshed(self.faces)
        return base if base.degree == self.degree else replace(base, degree=self.degree)

    def scene(self, base: Scene, body: Body) -> Scene:
        """The scene at this setting, on a body that `body` has made; the skin is not moved."""
        return with_changes(base, asdict(self)).with_(body=body)

    def finest(self, scene: Scene, finer: int) -> Setting:
        """The reference of the numerical error: mesh and time step `finer` times as fine."""
        return replace(
            self,
            faces=None if self.faces is None else finer * self.faces,
            degree=4,
            contact="elliptic" if scene.material.thickness is None else "layered",
            dt=self.dt / finer,
            integrator="rk4",
            tolerance=1e-12,
        )

    def words(self, base: Setting) -> str:
        """The differences from another setting, in the terms of the scene file and of calibrate."""
        parts = []
        for name, word in WORDS.items():
            if getattr(self, name) != getattr(base, name):
                parts.append(word(getattr(self, name)))
        return ", ".join(parts) or "the scene as it is"


def with_changes(scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """The scene with some values changed, by field of Setting, except those of its body.

    If the number of contacts determines the spacing of the lanes, it is changed in proportion.
    """
    parts: dict[str, Any] = {}
    loop = {name: changes[name] for name in ("dt", "integrator") if name in changes}
    if loop:
        parts["loop"] = replace(scene.loop, **loop)
    if "contact" in changes:
        parts["contact"] = changes["contact"]
    if "rate" in changes:
        parts["readout"] = replace(scene.readout, rate=changes["rate"])
    if "lane_spacing" in changes:
        lanes, spacing = scene.exploration, changes["lane_spacing"]
        contacts = lanes.contacts
        if contacts is not None:
            contacts = contacts * (lanes.lane_spacing / spacing)
        parts["exploration"] = replace(lanes, lane_spacing=spacing, contacts=contacts)
    return scene.with_(**parts)


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
"""Field of a Setting -> its value in words."""
