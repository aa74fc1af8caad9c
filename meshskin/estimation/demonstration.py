"""The paper's demonstration: a pose graph of perturbed displacements, solved from the origin.

Source: Cannata, Denei, Mastrogiovanni (ICRA 2010), section III and figures 6-9. The displacements
are the true ones of taxels that were active together, perturbed by white noise; no reading is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from ..core import se3
from ..core.arrays import Array
from ..core.errors import CalibrationError
from ..core.provenance import random_stream
from ..recording.recording import Recording
from .data.gather import taxel_rows
from .posegraph import PoseGraph

SIGMA, ROTATION_SIGMA = 1e-3, 0.02
"""Standard deviations of the noise of the displacements, m and rad."""
MIN_SHARED = 3
"""Contacts that two taxels must share for a displacement between them: three circles."""


@dataclass(frozen=True)
class Demonstration:
    """Estimates of the taxels along the iterations, in the body frame after rigid alignment."""

    truth: Array
    """True positions (j, 3) of the taxels in the graph, m."""
    iterates: Array
    """Positions (k, j, 3) along the iterations, all at the origin first, m."""
    rows: NDArray[np.int64]
    """Rows (j,) of the skin that the graph holds."""

    @property
    def mean_error(self) -> float:
        """Mean position error of the last iterate, m."""
        return float(np.linalg.norm(self.iterates[-1] - self.truth, axis=1).mean())


def coactive_pairs(recording: Recording, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (m, 2) of rows of `ids`, i < j, that were active in at least MIN_SHARED contacts.

    Raises CalibrationError for readings of other taxels.
    """
    column = taxel_rows(recording.reading_taxel, ids)
    shape = (len(recording.time), len(ids))
    active = coo_array((np.ones(len(column)), (recording.reading_contact, column)), shape=shape)
    shared = (active.T @ active).tocoo()
    keep = (shared.data >= MIN_SHARED) & (shared.row < shared.col)
    return np.stack([shared.row[keep], shared.col[keep]], axis=1).astype(np.int64)


def perturbed_graph(
    poses: Array,
    pairs: NDArray[np.int64],
    sigma: float,
    rotation_sigma: float,
    rng: np.random.Generator,
) -> PoseGraph:
    """Displacements between true `poses` (n, 4, 4) with noise of `sigma`, m, and `rotation_sigma`,
    rad.

    The first pose is the true one and anchors the graph; the information is that of the noise.
    """
    relative = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    measured = relative.copy()
    measured[:, :3, 3] += rng.normal(scale=sigma, size=(len(pairs), 3))
    measured[:, :3, :3] = relative[:, :3, :3] @ se3.exp_so3(
        rng.normal(scale=rotation_sigma, size=(len(pairs), 3))
    )
    information = np.diag([sigma**-2] * 3 + [rotation_sigma**-2] * 3)
    return PoseGraph(poses, pairs, measured, np.tile(information, (len(pairs), 1, 1)))


def demonstrate(
    poses: Array, ids: NDArray[np.int64], recording: Recording, seed: int = 0
) -> Demonstration:
    """Solve the perturbed graph of the true `poses` (n, 4, 4) of the taxels `ids` from the origin.

    The displacements have noise of SIGMA and ROTATION_SIGMA. Each iterate is aligned rigidly with
    the truth. Raises CalibrationError if fewer than half of the taxels were active together.
    """
    pairs = coactive_pairs(recording, ids)
    rows, local = np.unique(pairs, return_inverse=True)
    if len(rows) < max(2, len(ids) / 2):  # a figure of the few would not show the skin
        raise CalibrationError(
            "fewer than half of the taxels were active together with another",
            value=f"{len(rows)} of {len(ids)}",
            remedy="use a softer skin, more force or a closer spacing",
        )
    graph = perturbed_graph(
        poses[rows],
        local.reshape(-1, 2),
        SIGMA,
        ROTATION_SIGMA,
        random_stream(seed, "demonstration"),
    )
    solution = graph.solve(start="origin", keep_iterates=True)
    assert solution.iterates is not None
    truth = poses[rows, :3, 3]
    iterates = np.stack([aligned(p[:, :3, 3], truth) for p in solution.iterates])
    return Demonstration(truth, iterates, rows)


def aligned(estimate: Array, truth: Array) -> Array:
    """`estimate` (n, 3) aligned rigidly with `truth` (n, 3); a single point moves to its centre."""
    return se3.transform_points(se3.align(estimate, truth), estimate)
