"""Rays through a triangle mesh: embree's scene, directions, and how open a place is."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...core.arrays import Array, Index

DIRECTIONS = 64
"""Directions in which a point may be seen."""
GRAZING = 0.1
"""Least cosine of the angle between the normal and a direction in which a point is seen."""
LIFT = 1e-4
"""Distance of a ray's start from the surface, relative to the extent: rays are of single precision.
"""


def ray_scene(vertices: Array, faces: Index) -> Any:
    """The embree scene of a mesh, whose coordinates should be of the order of one."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene


def spread_directions(count: int) -> Array:
    """Unit vectors (count, 3), evenly over the sphere: the Fibonacci lattice.

    Source: Gonzalez, "Measurement of areas on a sphere using Fibonacci and latitude-longitude
    lattices", Mathematical Geosciences 42 (2010).
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def exposure(vertices: Array, faces: Index, points: Array, normals: Array) -> Array:
    """Share (n,) of the directions in front of points (n, 3) of a mesh, on the sides of the normals
    (n, 3), in which a straight line leads away from the mesh."""
    middle, extent = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    scene = ray_scene((vertices - middle) / extent, faces)
    start = ((points - middle) / extent + LIFT * normals).astype(np.float32)
    free, tried = np.zeros(len(points)), np.zeros(len(points))
    for way in spread_directions(DIRECTIONS):
        front = np.flatnonzero(normals @ way > GRAZING)
        ahead = np.tile(way.astype(np.float32), (len(front), 1))
        free[front] += np.asarray(scene.run(start[front], ahead)) < 0
        tried[front] += 1.0
    return free / np.maximum(tried, 1.0)
