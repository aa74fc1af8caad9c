"""A compliant sphere by Drake's hydroelastic contact: a field of pressure on a tetrahedral mesh.

Each body has a pressure that rises linearly from its surface to its middle. Bodies overlap, and
press on each other over the surface where the two pressures are equal, or, where one is rigid, over
its own surface. That surface consists of flat facets, which differ from contact to contact. The
force is Drake's integral of the pressure over it. A taxel reads the mean over its disc, where each
point of the surface presses on the skin beyond it. Source: R. Elandt and others, A pressure field
model for fast, robust approximation of net contact force and moment between nominally rigid
objects, IROS 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake import geometry as drake
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    ContactModel,
    CoulombFriction,
    HydroelasticContactInfo,
    MultibodyPlant,
)
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from scipy.interpolate import LinearNDInterpolator

from . import sphere
from .profiles import Array, Winkler
from .sphere import Touch

FORCE_TOLERANCE, MAX_TRIALS = 1e-4, 30
"""Relative error of the force, and depths that are tried for it."""
DEPTH = 0.8e-3
"""First depth, m, that is tried."""


@dataclass(frozen=True)
class Hydroelastic:
    """Pressures that Drake's surface of contact exerts on taxels of a compliant sphere."""

    modulus: float = Winkler().stiffness * sphere.RADIUS
    """Pressure, Pa, in the middle of the body; that at its surface is zero."""
    indenter_modulus: float | None = None
    """Pressure, Pa, in the middle of the indenter; None: it is rigid."""
    indenter_radius: float = sphere.INDENTER_RADIUS
    """m."""
    resolution: float = 3e-3
    """Length of the edges of the body's mesh, m, at most."""
    indenter_resolution: float = 1e-3
    """Length of the edges of the indenter's mesh, m, at most."""

    @cached_property
    def _built(self) -> tuple[Diagram, MultibodyPlant, Context]:
        """The body at the origin and the indenter, which floats; the plant's context."""
        builder, soft = DiagramBuilder(), drake.AddCompliantHydroelasticProperties
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        plant.set_contact_model(ContactModel.kHydroelastic)
        body, indenter = drake.ProximityProperties(), drake.ProximityProperties()
        soft(self.resolution, self.modulus, body)
        if self.indenter_modulus is None:
            drake.AddRigidHydroelasticProperties(self.indenter_resolution, indenter)
        else:
            soft(self.indenter_resolution, self.indenter_modulus, indenter)
        for each in (body, indenter):
            drake.AddContactMaterial(friction=CoulombFriction(0.0, 0.0), properties=each)
        inertia = SpatialInertia.SolidSphereWithMass(1.0, self.indenter_radius)
        link, here = plant.AddRigidBody("indenter", inertia), RigidTransform()
        ball = drake.Sphere(self.indenter_radius)
        plant.RegisterCollisionGeometry(plant.world_body(), here, self.shape(), "body", body)
        plant.RegisterCollisionGeometry(link, here, ball, "indenter", indenter)
        plant.Finalize()
        diagram = builder.Build()
        return diagram, plant, plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())

    def shape(self) -> drake.Shape:
        """The body."""
        return drake.Sphere(sphere.RADIUS)

    def contact(self, centre: Array) -> HydroelasticContactInfo | None:
        """The contact of the indenter at `centre` (3,), m; None where it touches nothing."""
        _, plant, context = self._built
        pose = RigidTransform(centre)
        plant.SetFreeBodyPose(context, plant.GetBodyByName("indenter"), pose)
        found = plant.get_contact_results_output_port().Eval(context)
        if not found.num_hydroelastic_contacts():
            return None
        return found.hydroelastic_contact_info(0)

    def pressed(
        self, point: Array, normal: Array, force: float, depth: float
    ) -> tuple[HydroelasticContactInfo, float]:
        """The contact under a force, N, and its depth, m; `depth` is the first one tried.

        Raises RuntimeError where none of the depths has that force.
        """
        for _ in range(MAX_TRIALS):
            found = self.contact(point + (self.indenter_radius - depth) * normal)
            along = abs(found.F_Ac_W().translational() @ normal) if found else 0.0
            if found and abs(along - force) < FORCE_TOLERANCE * force:
                return found, depth
            # of springs under a sphere the force grows as the square of the depth
            depth *= float(np.sqrt(force / along)) if along > 0 else 2.0
        raise RuntimeError(f"no depth has a force of {force:.3g} N")

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Means (m, n), Pa, of the pressure over the taxels' discs."""
        out, depth = np.zeros((len(touch.points), len(positions))), DEPTH
        for row, point, normal, force in zip(
            out, touch.points, touch.normals, touch.force, strict=True
        ):
            found, depth = self.pressed(point, normal, float(force), depth)
            surface = found.contact_surface()
            vertices = np.array(surface.tri_mesh_W().vertices())
            field = surface.tri_e_MN()
            pressure = np.array([field.EvaluateAtVertex(k) for k in range(len(vertices))])
            frame = np.stack(sphere.tangents(normal[None]), axis=2)[0]
            row[:] = disc_means((self.skin(vertices) - point) @ frame, pressure,
                                (positions - point) @ frame)  # fmt: skip
        return out

    def skin(self, points: Array) -> Array:
        """Points (k, 3), m, of the body's surface beyond points inside."""
        return np.asarray(sphere.RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True))


def disc_means(places: Array, pressure: Array, positions: Array) -> Array:
    """Means (n,), Pa, over discs at positions (n, 2), m, of pressures (k,), Pa, at places (k, 2).

    Linear between the places, zero beyond them.
    """
    out = np.zeros(len(positions))
    field = LinearNDInterpolator(places, pressure, fill_value=0.0)
    near = np.hypot(*positions.T) < np.hypot(*places.T).max() + sphere.DISC_RADIUS
    out[near] = field(positions[near, None] + sphere.disc_nodes()).mean(axis=1)
    return out
