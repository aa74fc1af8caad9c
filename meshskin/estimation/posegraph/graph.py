"""A pose graph: poses, and measured displacements between them with their information."""

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
from . import validation

if TYPE_CHECKING:
    from .problem import PoseGraphProblem
    from .solve import PoseGraphSolution
    from .topology import Topology

SINGULAR = 1e-12
"""A matrix (3, 3) is singular if its condition number is above 1 / SINGULAR: its inverse would have
fewer than four correct digits."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and measured displacements T_i_j between them.

    Residual of an edge: e = (R_i^T (t_j - t_i) - delta_t, Log(delta_R^T R_i^T R_j)), translation
    first, in m and rad, in the frame of pose i and of the measured frame j. Arrays are checked and
    copied; bad ones raise GraphError.
    """

    poses: Array
    """(n, 4, 4) T_w_i, initial estimates; those of the anchors stay fixed."""
    edges: NDArray[np.int64]
    """(m, 2) pairs (i, j) of rows of `poses`."""
    measurements: Array
    """(m, 4, 4) measured T_i_j."""
    information: Array
    """(m, 6, 6) inverse covariance of e; symmetric, positive semidefinite, may be singular."""
    ids: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(n,) ids of the poses in files; 0 to n - 1 by default."""

    def __repr__(self) -> str:
        return f"<PoseGraph: {len(self.poses)} poses, {len(self.edges)} displacements>"

    def __post_init__(self) -> None:
        poses = validation.transforms("poses", self.poses)
        edges = validation.edge_indices(self.edges, len(poses))
        ids = np.array(self.ids if len(self.ids) else np.arange(len(poses)), dtype=np.int64)
        if ids.shape != (len(poses),) or len(np.unique(ids)) != len(ids):
            raise GraphError("ids must be distinct, one per pose", value=f"shape {ids.shape}")
        values = {
            "poses": poses,
            "edges": edges,
            "measurements": validation.transforms("measurements", self.measurements, len(edges)),
            "information": validation.information_matrices(self.information, len(edges)),
            "ids": ids,
        }
        for name, value in values.items():
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
        """The first pose of each component: it stays fixed, and so fixes the gauge."""
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
        """What depends on the edges alone, shared by all graphs with the same edges."""
        from . import topology

        return topology.topology_cache.get(len(self.poses), self.edges, self.anchors)

    def problem(self, residual: str) -> PoseGraphProblem:
        """The NLP of this topology with the `residual` "log" or "vec", built once."""
        return self.topology.problem(residual)

    @classmethod
    def load(cls, path: str | Path) -> PoseGraph:
        """The graph in a g2o file (VERTEX_SE3:QUAT, EDGE_SE3:QUAT).

        Raises GraphError with the number of a line that cannot be read.
        """
        from . import g2o

        return cls(**g2o.read(path))

    def save(self, path: str | Path) -> None:
        """Write a g2o file with all digits. Raises OutputError if it cannot be written."""
        from . import g2o

        g2o.write(path, self.poses, self.edges, self.measurements, self.information, self.ids)

    def solve(
        self,
        objective: str = "geodesic",
        start: str | ArrayLike = "chordal",
        robust: str | None = None,
        keep_iterates: bool = False,
        certify: bool = False,
        limit: int | None = None,
    ) -> PoseGraphSolution:
        """The poses that minimize the objective.

        objective: "geodesic", 1/2 sum of e^T Omega e with
        e = (R_i^T (t_j - t_i) - dt, Log(dR^T R_i^T R_j)); or "chordal", sum of
        kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2, which has published optima.
        start: "chordal" (relaxation), "tree" (spanning tree), "origin" (every pose at its anchor)
        or poses (n, 4, 4). From "origin" the chordal objective is minimized first, because Log has
        no basin of convergence there.
        robust: "gnc", "huber" or "cauchy" reduce the weight of outlying displacements.
        keep_iterates: keep the poses after each iteration.
        certify: where the result of another start is not certified to be optimal, solve again from
        the chordal start and return the result of lower cost; see its `certificate`.
        limit: most iterations of IPOPT; the `status` says where they are too few.

        Raises UnknownNameError, GraphError.
        """
        from .solve import solve

        return solve(self, objective, start, robust, keep_iterates, certify, limit)


def _inverse_trace(matrices: Array) -> Array:
    """1 / tr(inv(M)) of positive semidefinite `matrices` (m, 3, 3); 0 where singular."""
    values = np.linalg.eigvalsh(matrices)
    singular = values[:, 0] <= SINGULAR * values[:, 2]
    safe = np.where(singular[:, None], 1.0, values)
    return np.asarray(np.where(singular, 0.0, 1.0 / np.sum(1.0 / safe, axis=1)))
