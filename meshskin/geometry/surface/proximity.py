"""The face nearest to a point: a KD-tree over samples of a mesh, searched in a scale near one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LIMIT = 400_000
"""samples that long faces are cut into, at most"""


class Proximity:
    """Samples of a triangle mesh (vertices (n, 3) m, faces (m, 3)) in a KD-tree."""

    def __init__(self, vertices: Array, faces: Index, least: int = 0) -> None:
        from scipy.spatial import KDTree

        self.vertices, self.faces = vertices, faces
        self.origin = vertices[faces[0, 0]]
        self.scale = float(np.max(np.ptp(vertices, axis=0)))
        points, self.owner = sample_faces(vertices, faces, least)
        self.cut = len(self.owner) > 1.2 * len(faces)  # whether long faces have several samples
        self.tree = KDTree((points - self.origin) / self.scale)

    def near(self, points: Array) -> Index:
        """The faces (n,) of the samples nearest to points (n, 3), m."""
        return np.asarray(self.owner[self.tree.query((points - self.origin) / self.scale)[1]])

    def exact(self, points: Array, candidates: int = 24) -> Index:
        """The nearest flat faces (n,) among those of the `candidates` nearest samples."""
        faces, gap, _ = self.nearby(points, candidates)
        return np.asarray(faces[np.arange(len(points)), np.argmin(gap, axis=1)])

    def nearby(self, points: Array, candidates: int) -> tuple[Index, Array, Array]:
        """The flat faces (n, k) of the `candidates` nearest samples, how far they are, and where.

        Distances (n, k) in m; feet by their barycentric weights (n, k, 2).
        """
        count = min(candidates, len(self.owner))
        if not len(points):
            return (
                np.zeros((0, count), dtype=np.intp),
                np.zeros((0, count)),
                np.zeros((0, count, 2)),
            )
        samples = self.tree.query((points - self.origin) / self.scale, k=count)[1]
        faces = self.owner[samples.reshape(len(points), count)]
        corners = self.vertices[self.faces[faces]]
        a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
        gap2, uv = triangle_foot(points[:, None], a, b - a, c - a)
        return faces, np.sqrt(gap2), uv


def thin_walled(vertices: Array, faces: Index) -> bool:
    """Whether faces that look away from each other are within about three faces' sizes."""
    from scipy.spatial import KDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal, middle = np.cross(b - a, c - a), (a + b + c) / 3.0
    some = slice(None, None, max(1, len(faces) // 20_000))
    middle -= middle[0]
    tree = KDTree(middle, compact_nodes=False, balanced_tree=False)  # soon built, for few queries
    near = tree.query(middle[some], k=min(24, len(faces)))[1]
    facing = np.einsum("nc,nkc->nk", normal[some], normal[near.reshape(len(near), -1)])
    return bool(np.any(facing < 0.0))


def sample_faces(vertices: Array, faces: Index, least: int = 0) -> tuple[Array, Index]:
    """Points (k, 3) on the faces, and their faces (k,), dense enough for a nearest-face guess.

    A face gets its middle; one far longer than the median, and any where there would be fewer than
    about `least` points, is halved across its longest side until the parts are short.
    """
    corners, owner = vertices[faces], np.arange(len(faces))
    side = _longest(corners)[0]
    aim = 4.0 * float(np.median(side))
    if least:
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = 0.5 * float(np.linalg.norm(np.cross(a, b), axis=1).sum())
        aim = min(aim, 2.0 * float(np.sqrt(area / least)))
    aim = max(aim, float(side.sum()) / LIMIT, 1e-30)
    done: list[tuple[Array, Index]] = []
    while len(corners):
        side, k = _longest(corners)
        short = side <= aim
        done.append((corners[short].mean(axis=1), owner[short]))
        corners, owner, k = corners[~short], owner[~short], k[~short]
        rows = np.arange(len(corners))
        tip, start, end = corners[rows, k], corners[rows, (k + 1) % 3], corners[rows, (k + 2) % 3]
        half = 0.5 * (start + end)
        corners = np.concatenate([np.stack([tip, start, half], 1), np.stack([tip, half, end], 1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate([p for p, _ in done]), np.concatenate([o for _, o in done])


def _longest(corners: Array) -> tuple[Array, Index]:
    """Lengths (m,) of the longest sides of triangles (m, 3, 3), and the corners opposite."""
    side = np.linalg.norm(corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]], axis=2)
    k = np.argmax(side, axis=1)
    return side[np.arange(len(corners)), k], k


def part_middles(count: int) -> Array:
    """Barycentric middles (count^2, 3) of a triangle cut into count^2 equal triangles."""
    up = [(3 * i + 1, 3 * j + 1) for i in range(count) for j in range(count - i)]
    down = [(3 * i + 2, 3 * j + 2) for i in range(count - 1) for j in range(count - 1 - i)]
    uv = np.array(up + down) / (3.0 * count)
    return np.column_stack([1.0 - uv.sum(axis=1), uv])


def triangle_foot(p: Array, a: Array, ab: Array, ac: Array) -> tuple[Array, Array]:
    """Squared distances of points p to triangles a, a + ab, a + ac (all (..., 3)), and their feet.

    The feet are given by their weights (..., 2) of ab and ac.
    """
    ap = p - a
    uv = _barycentric(ap, ab, ac)
    flat = ap - uv[..., :1] * ab - uv[..., 1:] * ac
    within = (uv.min(axis=-1) >= 0) & (uv.sum(axis=-1) <= 1)
    best = np.where(within, np.sum(flat**2, axis=-1), np.inf)
    origin, east, north = np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    sides = (
        (ap, ab, origin, east),
        (ap, ac, origin, north),
        (ap - ab, ac - ab, east, north - east),
    )
    for start, edge, first, way in sides:
        length2 = np.maximum(np.sum(edge * edge, axis=-1), 1e-300)
        t = np.clip(np.sum(start * edge, axis=-1) / length2, 0.0, 1.0)[..., None]
        gap = np.sum((start - t * edge) ** 2, axis=-1)
        nearer = gap < best
        best = np.where(nearer, gap, best)
        uv = np.where(nearer[..., None], first + t * way, uv)
    return best, uv


def _barycentric(offset: Array, ab: Array, ac: Array) -> Array:
    """Weights (..., 2) of ab and ac in the projection of offsets on their planes."""
    e, f, g = (np.sum(x * y, axis=-1) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    x, y = np.sum(offset * ab, axis=-1), np.sum(offset * ac, axis=-1)
    area2 = np.maximum(e * g - f * f, 1e-300)
    return np.stack([(g * x - f * y) / area2, (e * y - f * x) / area2], axis=-1)
