"""A thin layer on a prism, touched about one of its edges, where no quadric describes the body.

Pressure is the layer's stiffness times the overlap of the indenter with it along the normal of the
face; a taxel reads its mean over a disc that is bent over the edge. No contact model of the package
describes either.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from meshskin.geometry.body import Body
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording

from . import sphere

if TYPE_CHECKING:
    from .profiles import Array

APOTHEM, HEIGHT = 0.04, 0.2
"""Distance of the faces from the axis, and length of the prism, m."""
STIFFNESS = 3e8
"""Pressure of the layer by its indentation, Pa/m: 0.6 mm deep under the mean force."""
NOISE, SILENT = 0.01, 3.0
"""Noise relative to the median taxel's largest reading, and the threshold relative to the noise."""
REACH, STEP = 8e-3, 0.5e-3
"""Half-width and step, m, of the grid over which the force of a contact is summed."""
BISECTIONS = 30
"""Halvings of the depth of a contact, from DEEPEST m on."""
DEEPEST = 3e-3
DISC_POINTS = 100
"""Points of a taxel's disc, on a spiral of the golden angle."""


@dataclass(frozen=True)
class EdgeSample:
    """A recording, and apart from it what no calibration may know."""

    recording: Recording
    threshold: float
    """Level that readings had to pass, Pa."""
    positions: Array
    """True positions (n, 3), m."""


@dataclass(frozen=True)
class Edge:
    """Taps about an edge of a prism of `faces` faces; 5 by 5 taxels, one column beyond the edge."""

    faces: int = 6
    contacts: int = 150

    @cached_property
    def width(self) -> float:
        """Width of a face, m."""
        return float(2 * APOTHEM * np.tan(np.pi / self.faces))

    @cached_property
    def body(self) -> Body:
        """The prism as a mesh."""
        import trimesh

        radius = APOTHEM / np.cos(np.pi / self.faces)
        mesh = trimesh.creation.cylinder(radius, HEIGHT, sections=self.faces)
        turn = trimesh.transformations.rotation_matrix(np.pi / self.faces, [0, 0, 1])
        return Body.from_mesh(mesh.apply_transform(turn))

    def at(self, arc: Array, height: Array) -> tuple[Array, Array]:
        """Points and normals (..., 3) at arc lengths from the middle of a face, and heights, m."""
        face = np.round(arc / self.width)
        angle, along = 2 * np.pi * face / self.faces, arc - self.width * face
        zero = np.zeros_like(angle)
        normal = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
        tangent = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
        up = height[..., None] * np.array([0.0, 0.0, 1.0])
        return APOTHEM * normal + along[..., None] * tangent + up, normal

    def record(self, seed: int) -> EdgeSample:
        """The recording of one seed."""
        rng = np.random.default_rng(seed)
        pitch = sphere.SPACING
        rows = pitch * (np.arange(5) - 2 + rng.uniform(-0.2, 0.2))
        columns = self.width / 2 + pitch * (np.arange(5) - 3.8 + rng.uniform(-0.1, 0.1))
        arc, height = (x.ravel() for x in np.meshgrid(columns, rows))
        across = rng.uniform(arc.min() - 3e-3, arc.max() + 1e-3, self.contacts)
        along = rng.uniform(rows.min() - 3e-3, rows.max() + 3e-3, self.contacts)
        force = sphere.FORCE * np.exp(sphere.FORCE_SPREAD * rng.standard_normal(self.contacts))
        points, normals = self.at(across, along)
        centre = self._indenter(across, along, force)
        reading = STIFFNESS * self._felt(arc, height, centre)
        noise = NOISE * float(np.median(reading.max(axis=0)))
        reading += noise * rng.standard_normal(reading.shape)
        contact, taxel = np.nonzero(reading > SILENT * noise)
        time = sphere.FRAME * np.arange(self.contacts)
        contacts = [np.ascontiguousarray(x) for x in (time, *points.T, *normals.T, force)]
        readings = [time[contact], taxel.astype(np.int32), reading[contact, taxel]]
        recording = Recording(
            pa.table(contacts, schema=CONTACT_SCHEMA),
            pa.table(readings, schema=READING_SCHEMA),
            {"taxel_ids": list(range(len(arc))), "disc_radius_m": sphere.DISC_RADIUS},
        )
        return EdgeSample(recording, SILENT * noise, self.at(arc, height)[0])

    def _indenter(self, across: Array, along: Array, force: Array) -> Array:
        """Centres (m, 3), m, of the indenter where the layer bears the forces (m,), N."""
        points, normals = self.at(across, along)
        near = np.arange(-REACH, REACH + STEP / 2, STEP)
        u, v = (x.ravel() for x in np.meshgrid(near, near))
        around = self.at(across[:, None] + u, along[:, None] + v)
        low, high = np.zeros(len(force)), np.full(len(force), DEEPEST)
        for _ in range(BISECTIONS):
            depth = (low + high) / 2
            centre = points + (sphere.INDENTER_RADIUS - depth)[:, None] * normals
            more = STIFFNESS * STEP**2 * overlap(centre, *around).sum(axis=1) < force
            low, high = np.where(more, depth, low), np.where(more, high, depth)
        return points + (sphere.INDENTER_RADIUS - low)[:, None] * normals

    def _felt(self, arc: Array, height: Array, centre: Array) -> Array:
        """Mean overlaps (m, n), m, over the discs of taxels with indenters at `centre` (m, 3)."""
        k = np.arange(DISC_POINTS) + 0.5
        radius = sphere.DISC_RADIUS * np.sqrt(k / DISC_POINTS)
        disc = radius * np.exp(1j * np.pi * (1 + 5**0.5) * k)
        points, normals = self.at(arc[:, None] + disc.real, height[:, None] + disc.imag)
        each = overlap(centre, points.reshape(1, -1, 3), normals.reshape(1, -1, 3))
        return np.asarray(each.reshape(len(centre), len(arc), -1).mean(axis=2))


def overlap(centre: Array, points: Array, normals: Array) -> Array:
    """Overlaps (m, k), m, of indenters at `centre` (m, 3) with the lines into the body at points
    (m or 1, k, 3), m, along the normals there."""
    apart = points - centre[:, None]
    along = np.sum(apart * normals, axis=2)
    root = along**2 - np.sum(apart**2, axis=2) + sphere.INDENTER_RADIUS**2
    return np.where(root > 0, np.maximum(along + np.sqrt(np.maximum(root, 0)), 0), 0)
