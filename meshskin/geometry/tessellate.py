"""Triangle meshes of the primitives: vertices (n, 3) m on the exact surface, faces (m, 3)."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index


def sphere(faces: int) -> tuple[Array, Index]:
    """Unit icosphere with the number of faces 20 * 4^k nearest (in ratio) to `faces`."""
    from trimesh.creation import icosphere

    level = max(0, round(float(np.log(max(faces, 20) / 20.0) / np.log(4.0))))
    mesh = icosphere(subdivisions=level)
    vertices = np.array(mesh.vertices)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), np.array(mesh.faces)


def ellipsoid(radii: Array, faces: int) -> tuple[Array, Index]:
    """Ellipsoid of semi-axes `radii` (3,), as the image of an icosphere.

    Scaling the sphere by the radii leaves large angles between faces at sharp ends, the inverse of
    the Gauss map large faces on flat sides; halfway between, both vary by the square root of the
    ratio of the radii.
    """
    directions, triangles = sphere(faces)
    scaled = np.sqrt(radii) * directions
    return radii * scaled / np.linalg.norm(scaled, axis=1, keepdims=True), triangles


def cylinder(radius: float, length: float, faces: int) -> tuple[Array, Index]:
    """Cylinder along z with flat caps: rows of triangles on the side, rings on the caps."""
    area = 2.0 * np.pi * radius * (radius + length)
    step = float(np.sqrt(area / (faces * np.sqrt(3.0) / 4.0)))
    n = max(2, round(2.0 * np.pi * radius / (6.0 * step)))
    rows = max(1, round(length / (2.0 * np.pi * radius / (6 * n) * np.sqrt(3.0) / 2.0)))
    cap = np.array([radius * k / n for k in range(n + 1)])
    counts = [1, *(6 * k for k in range(1, n + 1))]
    flat = np.zeros(n + 1)
    return _stitch(_capped(length, rows, (flat, cap), (flat[1:], cap[n - 1 :: -1]), counts))


def capsule(radius: float, length: float, faces: int) -> tuple[Array, Index, Index]:
    """Capsule along z: rows of triangles on the cylinder, half octahedra at its ends.

    Third, the seams (k, 2): edges, by their vertices, between the cylinder and the half spheres.
    """
    area_sphere, area_side = 4.0 * np.pi * radius**2, 2.0 * np.pi * radius * length
    n = max(2, round(float(np.sqrt(faces / 8.0 * area_sphere / (area_sphere + area_side)))))
    step = 2.0 * np.pi * radius / (4 * n)
    rows = max(1, round(length / (step * np.sqrt(3.0) / 2.0))) if length > 0 else 0
    latitudes = np.linspace(0.5 * np.pi, 0.0, n + 1), np.linspace(0.0, -0.5 * np.pi, n + 1)[1:]
    upper, lower = ((radius * np.sin(a), radius * np.cos(a)) for a in latitudes)
    rings = _capped(length, rows, upper, lower, [max(1, 4 * k) for k in range(n + 1)])
    starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
    around = np.arange(4 * n)
    seam = np.column_stack([around, (around + 1) % (4 * n)])
    return *_stitch(rings), np.concatenate([seam + starts[n], seam + starts[n + rows]])


def torus(major: float, minor: float, faces: int) -> tuple[Array, Index]:
    """Torus about z as a regular grid with about `faces` triangles."""
    around = max(6, round(float(np.sqrt(faces * major / (2.0 * minor)))))
    across = max(6, round(faces / (2.0 * around)))
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = 2.0 * np.pi * i / around, 2.0 * np.pi * (j + 0.5 * (i % 2)) / across
    if around % 2:
        b = 2.0 * np.pi * j / across
    radial = major + minor * np.cos(b)
    vertices = np.stack([radial * np.cos(a), radial * np.sin(a), minor * np.sin(b)], axis=-1)
    node, up = i * across + j, i * across + (j + 1) % across
    east, east_up = ((i + 1) % around) * across + j, ((i + 1) % around) * across + (j + 1) % across
    odd = (i % 2 == 1) & (around % 2 == 0)
    first = np.where(
        odd[..., None], np.stack([node, east, east_up], -1), np.stack([node, east, up], -1)
    )
    second = np.where(
        odd[..., None], np.stack([node, east_up, up], -1), np.stack([east, east_up, up], -1)
    )
    return vertices.reshape(-1, 3), np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def _capped(
    length: float,
    rows: int,
    upper: tuple[Array, Array],
    lower: tuple[Array, Array],
    counts: list[int],
) -> list[Array]:
    """Closed rings of points (count, 3), m, of a cylinder of `length` with a cap at each end.

    `upper`, `lower`: heights of the rings of a cap over the end of the cylinder, and their radii;
    the last ring of the upper cap is the end of the cylinder. `counts`: points of the upper rings.
    Every second ring of the cylinder is rotated by half a step: its triangles are equilateral.
    """
    n, side = len(counts) - 1, np.linspace(0.5, -0.5, rows + 1)[1:] * length
    heights = [*(0.5 * length + upper[0]), *side, *(-0.5 * length + lower[0])]
    radial = [*upper[1], *[upper[1][-1]] * rows, *lower[1]]
    points = [*counts, *[counts[-1]] * rows, *counts[:n][::-1]]
    rings = []
    for k, (z, r, count) in enumerate(zip(heights, radial, points, strict=True)):
        shift = 0.5 * ((k - n) % 2) if n <= k <= n + rows else 0.0
        a = (np.arange(count) + shift) * 2.0 * np.pi / count
        rings.append(np.column_stack([r * np.cos(a), r * np.sin(a), np.full(count, z)]))
    return rings


def _stitch(rings: list[Array]) -> tuple[Array, Index]:
    """Triangulate between closed rings of points, top to bottom, in the order of their angles."""
    starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
    faces: list[tuple[int, int, int]] = []
    for k in range(len(rings) - 1):
        upper, lower = rings[k], rings[k + 1]
        n, m = len(upper), len(lower)
        a0, b0 = int(starts[k]), int(starts[k + 1])
        i = j = 0
        turn_a = (np.arctan2(upper[0, 1], upper[0, 0]) + np.arange(n + 1) * 2 * np.pi / n).tolist()
        turn_b = (np.arctan2(lower[0, 1], lower[0, 0]) + np.arange(m + 1) * 2 * np.pi / m).tolist()
        while (i < n and n > 1) or (j < m and m > 1):
            down = m > 1 and j < m and (n == 1 or i >= n or turn_b[j + 1] <= turn_a[i + 1])
            if down:
                faces.append((a0 + i % n, b0 + j % m, b0 + (j + 1) % m))
                j += 1
            else:
                faces.append((a0 + i % n, b0 + j % m, a0 + (i + 1) % n))
                i += 1
    return np.concatenate(rings), np.array(faces, dtype=np.intp)
