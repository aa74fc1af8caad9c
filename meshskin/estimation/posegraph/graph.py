"""A pose graph: poses, and measured displacements between them with their information."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array
from ...core.errors import GraphError
from ...core.value import Value
from ...geometry.mesh.topology import connected_components
from . import validation

if TYPE_CHECKING:
    from ...core.progress import Progress
    from .problem import PoseGraphProblem, Topology
    from .solve import PoseGraphSolution


@dataclass(frozen=True, eq=False)
class PoseGraph(Value):
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
    """(m, 6, 6) inverse covariance of e; symmetric, may be singular. The geodesic objective takes
    `semidefinite_information`, the chordal one `chordal_weights`."""
    ids: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(n,) ids of the poses in files; 0 to n - 1 by default."""

    def __repr__(self) -> str:
        parts = len(self.anchors)  # their poses relative to each other stay as they are
        joined = f", {parts} parts that no displacement joins" if parts > 1 else ""
        return f"<PoseGraph: {len(self.poses)} poses, {len(self.edges)} displacements{joined}>"

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
        i, j = self.edges.T
        return connected_components(i, j, len(self.poses))

    @cached_property
    def anchors(self) -> NDArray[np.int64]:
        """The first pose of each component: it stays fixed, and so fixes the gauge."""
        return np.asarray(np.unique(self.components, return_index=True)[1], dtype=np.int64)

    @cached_property
    def chordal_weights(self) -> tuple[Array, Array]:
        """(tau, kappa), (m,) each: 3 / tr(inv(I_t)) and 3 / (2 tr(inv(I_R))), 0 where singular.

        The information need not be positive semidefinite as (6, 6): the rest of it is not used.
        A block whose inverse has a negative trace has the weight 0; where that of an indefinite
        block is positive, the weight may be far too large. Warnings count these displacements.
        Source: Rosen et al., "SE-Sync", IJRR 38 (2019), section 6.
        """
        tau, kappa, negative, indefinite = validation.chordal_weights(self.information)
        self._warn(
            negative,
            "has a translation or rotation block that is not positive semidefinite: its chordal "
            "weight is zero",
        )
        self._warn(
            indefinite,
            "has an indefinite translation or rotation block: its chordal weight, by the trace of "
            "the inverse, may be far too large",
        )
        return tau, kappa

    @cached_property
    def semidefinite_information(self) -> Array:
        """(m, 6, 6) `information`, where it is not positive semidefinite the nearest such matrix.

        A warning counts the displacements whose information is projected.
        """
        projected, indefinite = validation.project_to_semidefinite(self.information)
        words = "is not positive semidefinite: projected onto the semidefinite cone"
        self._warn(indefinite, words)
        projected.setflags(write=False)
        return projected

    def _warn(self, edges: NDArray[np.bool_], words: str) -> None:
        """Warn, with their number, of information of `edges` (m,) that is not semidefinite."""
        if count := int(edges.sum()):
            text = f"the information of {count} of {len(edges)} displacements {words}"
            warnings.warn(text, RuntimeWarning, stacklevel=3)

    @property
    def topology(self) -> Topology:
        """What depends on the edges alone, shared by all graphs with the same edges."""
        from . import problem

        return problem.topology_cache.get(len(self.poses), self.edges, self.anchors)

    def problem(self, residual: str) -> PoseGraphProblem:
        """The NLP of this topology with the `residual` "log" or "vec", built once."""
        return self.topology.problem(residual)

    @classmethod
    def load(cls, path: str | Path) -> PoseGraph:
        """The graph in a g2o file (VERTEX_SE3:QUAT, EDGE_SE3:QUAT; VERTEX_SE2, EDGE_SE2).

        A 2D graph is loaded into the plane z = 0; `g2o.lift_information` gives the information
        about z, roll and pitch, and the solution stays in the plane.

        Raises GraphError with the number of a line that cannot be read.
        """
        from . import g2o

        return cls(**g2o.read(path))

    def save(self, path: str | Path) -> None:
        """Write a 3D g2o file with all digits. Raises OutputError if it cannot be written."""
        from . import g2o

        g2o.write(path, self)

    def solve(
        self,
        objective: str = "geodesic",
        start: str | ArrayLike = "chordal",
        robust: str | None = None,
        keep_iterates: bool = False,
        certify: bool = False,
        limit: int | None = None,
        progress: Progress | None = None,
    ) -> PoseGraphSolution:
        """The poses that minimize the objective.

        objective: "geodesic", 1/2 sum of e^T Omega e with
        e = (R_i^T (t_j - t_i) - dt, Log(dR^T R_i^T R_j)); or "chordal", sum of
        kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2, which has published optima.
        start: "chordal" (relaxation), "tree" (spanning tree), "origin" (every pose at its anchor)
        or poses (n, 4, 4), of which each component is moved as a whole to its anchor. From "origin"
        the chordal objective is minimized first, because Log has no basin of convergence there.
        robust: "gnc", "huber" or "cauchy" reduce the weight of outlying displacements.
        keep_iterates: keep the poses after each iteration.
        certify: where the result of another start is not certified to be optimal, solve again from
        the chordal start and return the result of lower cost; see its `certificate`.
        limit: most iterations of IPOPT; the `status` says where they are too few.
        progress: progress("solve", done, total), called after each iteration.

        Raises UnknownNameError; GraphError where no displacement has information (for the
        chordal objective: where the blocks of all information matrices are singular).
        """
        from .solve import solve

        return solve(self, objective, start, robust, keep_iterates, certify, limit, progress)
