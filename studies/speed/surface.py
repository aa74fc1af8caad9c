"""Closest points on meshes: error against the exact surface and time a query, beside trimesh.

For each primitive and mesh size, 10,000 points within 3 mm of the surface: the smooth surface
(quintic patches on quartic vertex jets) from a cold start and from the face known before, and
trimesh's flat closest point (in millimetres, where its absolute tolerance does no harm).

    OMP_NUM_THREADS=1 python studies/speed/surface.py [--points 10000]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import perf_counter

import numpy as np
import trimesh

from meshskin import Body

SIZES = (1280, 5120, 20480)
BODIES: dict[str, Callable[[int], Body]] = {
    "sphere": lambda faces: Body.sphere(0.1, faces=faces),
    "ellipsoid": lambda faces: Body.ellipsoid((0.1, 0.07, 0.05), faces=faces),
    "torus": lambda faces: Body.torus(0.1, 0.04, faces=faces),
    "capsule": lambda faces: Body.capsule(0.05, 0.2, faces=faces),
}
COLUMNS = (
    "body        faces  method   point um  dist um    normal deg  curvature %  us/query  prepare s"
)


def main() -> None:
    """Print one row a body, size and method: errors are RMS, the time is the best of three."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=10_000)
    count = parser.parse_args().points
    print(COLUMNS)
    for name, make in BODIES.items():
        for size in SIZES:
            for row in compare(make(size), count):
                print(f"{name:10s}", row)


def compare(body: Body, count: int) -> list[str]:
    """Rows for one body."""
    points = near(body, count)
    exact = body.exact.closest(points)
    started = perf_counter()
    hit = body.closest(points[:1])
    prepared = perf_counter() - started
    hit = body.closest(points)
    offset = np.linalg.norm(hit.point - exact.point, axis=1)
    distance = hit.distance - exact.distance
    normal = np.degrees(np.linalg.norm(np.cross(hit.normal, exact.normal), axis=1))
    scale = np.abs(exact.curvature).max(axis=1, keepdims=True)
    curvature = (hit.curvature - exact.curvature) / scale
    errors = (1e6 * rms(offset), 1e6 * rms(distance), rms(normal), 1e2 * rms(curvature))
    faces = len(body.mesh.faces)
    cold = best(lambda: body.closest(points)) / count
    warm = best(lambda: body.closest(points, face=hit.face)) / count
    flat = body.mesh.copy()
    flat.apply_scale(1e3)
    few = points[: count // 10] * 1e3
    foot, gap, owner = trimesh.proximity.closest_point(flat, few)
    head = slice(len(few))
    turn = np.cross(flat.face_normals[owner], exact.normal[head])
    flat_errors = (
        1e6 * rms(np.linalg.norm(foot * 1e-3 - exact.point[head], axis=1)),
        1e6 * rms(gap * 1e-3 - np.abs(exact.distance[head])),
        np.degrees(rms(np.linalg.norm(turn, axis=1))),
        100.0,
    )
    slow = best(lambda: trimesh.proximity.closest_point(flat, few)) / len(few)
    return [
        line(faces, "patches", errors, cold, prepared),
        line(faces, "  warm", errors, warm, prepared),
        line(faces, "trimesh", flat_errors, slow, 0.0),
    ]


def near(body: Body, count: int) -> np.ndarray:
    """Points (count, 3) within 3 mm of the exact surface, spread over the faces."""
    rng = np.random.default_rng(0)
    corners = body.mesh.triangles[rng.integers(len(body.mesh.faces), size=count)]
    on = body.exact.closest(np.einsum("nk,nkc->nc", rng.dirichlet((1, 1, 1), count), corners))
    return on.point + rng.uniform(-3e-3, 3e-3, size=(count, 1)) * on.normal


def rms(x: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def best(run: Callable[[], object], repeats: int = 3) -> float:
    """Shortest time in s of some runs."""
    times = []
    for _ in range(repeats):
        started = perf_counter()
        run()
        times.append(perf_counter() - started)
    return min(times)


def line(faces: int, method: str, errors: tuple[float, ...], query: float, prepare: float) -> str:
    """One row of the table."""
    point, distance, normal, curvature = errors
    return (
        f"{faces:6d}  {method:8s} {point:8.3g} {distance:8.3g}    {normal:10.3g}  "
        f"{curvature:11.3g}  {1e6 * query:8.2f}  {prepare:9.3f}"
    )


if __name__ == "__main__":
    main()
