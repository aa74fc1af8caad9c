"""A pose graph: poses, and measured displacements between them, each with its information."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ...core.errors import GraphError
from ...core.se3 import Array

if TYPE_CHECKING:
    from .problem import PoseGraphProblem
    from .solve import Solution
    from .topology import Topology

ROTATION_LIMIT = 1e-6
"""Largest entry by which R^T R may differ from the identity, as files with few digits do."""
NEGATIVE_LIMIT = 1e-9
"""Rounding of an information matrix, asymmetric or below zero, relative to its largest entry."""
LARGEST = 1e100
"""Largest entry of an information matrix: beyond, its squares leave double precision."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and measured displacements T_i_j between them.

    Residual of an edge: e = (R_i^T (t_j - t_i) - delta_t, Log(delta_R^T R_i^T R_j)), translation
    first, in m and rad, in the frame of pose i and of the measured frame j. Arrays are checked and
    copied; bad ones raise GraphError.
    """

    poses: Array
    """(n, 4, 4) T_w_i, the estimates to start from; those that anchor the graph are kept."""
    edges: NDArray[np.int64]
    """(m, 2) pairs (i, j) of rows of `poses`."""
    measurements: Array
    """(m, 4, 4) measured T_i_j."""
    information: Array
    """(m, 6, 6) inverse covariance of e; symmetric, positive semidefinite, may be singular."""
    ids: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(n,) names of the poses in files; 0 to n - 1 if not given."""

    def __repr__(self) -> str:
        return f"<PoseGraph: {len(self.poses)} poses, {len(self.edges)} displacements>"

    def __post_init__(self) -> None:
        poses = transforms("poses", self.poses)
        edges = _edges(self.edges, len(poses))
        measurements = transforms("measurements", self.measurements, len(edges))
        information = _information(self.information, len(edges))
        ids = np.array(self.ids if len(self.ids) else np.arange(len(poses)), dtype=np.int64)
        if ids.shape != (len(poses),) or len(np.unique(ids)) != len(ids):
            raise GraphError("ids must be distinct, one a pose", value=f"shape {ids.shape}")
        values = (poses, edges, measurements, information, ids)
        names = ("poses", "edges", "measurements", "information", "ids")
        for name, value in zip(names, values, strict=True):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @cached_property
    def components(self) -> NDArray[np.int64]:
        """(n,) the connected component of each pose, numbered by its first pose."""
        n, (i, j) = len(self.poses), self.edges.T
        links = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
        labels = sparse.csgraph.connected_components(links, directed=False)[1]
        return np.asarray(labels, dtype=np.int64)

    @cached_property
    def anchors(self) -> NDArray[np.int64]:
        """The first pose of each component: it stays where it is, and fixes the gauge."""
        return np.asarray(np.unique(self.components, return_index=True)[1], dtype=np.int64)

    @cached_property
    def chordal_weights(self) -> tuple[Array, Array]:
        """(tau, kappa), (m,) each: 3 / tr(inv(I_t)) and 3 / (2 tr(inv(I_R))), 0 where singular.

        Source: Rosen et al., "SE-Sync", IJRR 38 (2019), section 6.
        """
        return (
            3.0 * _inverse_trace(self.information[:, :3, :3]),
            1.5 * _inverse_trace(self.information[:, 3:, 3:]),
        )

    @property
    def topology(self) -> Topology:
        """What follows from the edges alone, shared by all graphs that have them."""
        from . import topology

        return topology.kept.get(len(self.poses), self.edges, self.anchors)

    def problem(self, residual: str) -> PoseGraphProblem:
        """The NLP of this topology with the `residual` "log" or "vec", built once."""
        return self.topology.problem(residual)

    @classmethod
    def load(cls, path: str | Path) -> PoseGraph:
        """The graph in a g2o file (VERTEX_SE3:QUAT, EDGE_SE3:QUAT); GraphError names bad lines."""
        from . import g2o

        return g2o.load(path)

    def save(self, path: str | Path) -> None:
        """Write a g2o file, all digits."""
        from . import g2o

        g2o.save(self, path)

    def solve(
        self,
        objective: str = "geodesic",
        start: str | ArrayLike = "chordal",
        robust: str | None = None,
        keep_iterates: bool = False,
        certify: bool = False,
        limit: int | None = None,
    ) -> Solution:
        """The poses that minimise the objective; arguments as in `posegraph.solve.solve`."""
        from .solve import solve

        return solve(self, objective, start, robust, keep_iterates, certify, limit)


def transforms(name: str, values: ArrayLike, count: int | None = None) -> Array:
    """A checked copy of rigid transforms (count, 4, 4); GraphError says what is wrong with them."""
    array = np.array(values, dtype=float)
    if array.size == 0 and name == "measurements":
        array = array.reshape(0, 4, 4)
    shape = (len(array) if count is None else count, 4, 4)
    if array.shape != shape or (not len(array) and name == "poses"):
        wanted = "(n, 4, 4)" if count is None else str(shape)
        raise GraphError(f"{name} of the wrong shape", value=array.shape, limit=wanted)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))
    if len(bad):
        raise GraphError(f"{name} are not finite", value=f"row {bad[0]}")
    r = array[:, :3, :3]
    off = np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max(axis=(1, 2), initial=0.0)
    off = np.where(np.linalg.det(r) > 0, off, np.inf)
    off = np.maximum(off, np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0))
    if (off > ROTATION_LIMIT).any():
        row = int(np.argmax(off > ROTATION_LIMIT))
        raise GraphError(
            f"{name} are no rigid transforms",
            value=f"row {row}, off by {off[row]:.3g}",
            limit=ROTATION_LIMIT,
            remedy="normalise the rotations",
        )
    return array


def _edges(values: ArrayLike, poses: int) -> NDArray[np.int64]:
    given = np.array(values)
    if given.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 2:
        raise GraphError("edges of the wrong shape", value=given.shape, limit="(m, 2)")
    if not np.issubdtype(given.dtype, np.integer):
        raise GraphError("edges must be whole numbers", value=given.dtype)
    edges = given.astype(np.int64)
    outside = ((edges < 0) | (edges >= poses)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise GraphError(
            "an edge names a pose that does not exist",
            value=f"edge {row} {tuple(edges[row].tolist())}",
            limit=f"0 to {poses - 1}",
        )
    loop = edges[:, 0] == edges[:, 1]
    if loop.any():
        row = int(np.argmax(loop))
        raise GraphError(
            "an edge joins a pose to itself",
            value=f"edge {row}, pose {edges[row, 0]}",
            remedy="leave it out: it says nothing about the poses",
        )
    return edges


def _information(values: ArrayLike, count: int) -> Array:
    array = np.array(values, dtype=float)
    if array.shape == (6, 6):
        array = np.tile(array, (count, 1, 1))
    if array.size == 0 and count == 0:
        return np.empty((0, 6, 6))
    if array.shape != (count, 6, 6):
        raise GraphError("information of the wrong shape", value=array.shape, limit=(count, 6, 6))
    bad = np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))
    if len(bad):
        raise GraphError("information is not finite", value=f"edge {bad[0]}")
    size = np.abs(array).max(axis=(1, 2))
    if (size > LARGEST).any():
        row = int(np.argmax(size > LARGEST))
        raise GraphError(
            "information is too large to compute with",
            value=f"edge {row}: {size[row]:.3g}",
            limit=f"{LARGEST:g}",
            remedy="scale all of it down: the poses stay the same",
        )
    skew = np.abs(array - np.swapaxes(array, 1, 2)).max(axis=(1, 2))
    array = (array + np.swapaxes(array, 1, 2)) / 2
    lowest = np.linalg.eigvalsh(array)[:, 0]
    wrong = (skew > NEGATIVE_LIMIT * size) | (lowest < -NEGATIVE_LIMIT * size)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise GraphError(
            "information is not symmetric positive semidefinite",
            value=f"edge {row}: lowest eigenvalue {lowest[row]:.3g}, asymmetry {skew[row]:.3g}",
            limit=f"{NEGATIVE_LIMIT:g} of its largest entry",
        )
    return array


def _inverse_trace(matrices: Array) -> Array:
    """1 / tr(inv(M)) of positive semidefinite `matrices` (m, 3, 3); 0 where singular."""
    values = np.linalg.eigvalsh(matrices)
    singular = values[:, 0] <= 1e-12 * values[:, 2]
    safe = np.where(singular[:, None], 1.0, values)
    return np.asarray(np.where(singular, 0.0, 1.0 / np.sum(1.0 / safe, axis=1)))
