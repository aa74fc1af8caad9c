"""The two readings of the paper's figure 9: errors of estimates over the noise.

Source: Cannata, Denei, Mastrogiovanni (ICRA 2010), eq. 1 and 15, and figure 9. In `noisy_poses`,
poses have white noise of one level: the body's in every contact, from which eq. 15 trilaterates the
start of each taxel, and those of both taxels that a displacement is measured between, drawn anew
for each. The displacements have equal weights. The relaxation and the noise of the rotations are
chosen here. In `noise_sweep`, displacements have noise, and a pose graph is solved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from meshskin.core import se3
from meshskin.core.arrays import Array, sums_by_group
from meshskin.core.provenance import random_stream
from meshskin.estimation.data.measurements import Measurements
from meshskin.estimation.demonstration import aligned, perturbed_graph
from meshskin.estimation.trilateration import eq15

ITERATIONS = (1, 100, 1000)
"""Iterations after which figure 9 shows the error."""
TURN = 20.0
"""Ratio of the noise of rotations to that of displacements, rad/m: 0.02 rad for 1 mm."""


@dataclass(frozen=True)
class NoisyPoses:
    """Mean position errors of the taxels after rigid alignment, by level of noise and seed."""

    sigmas: Array
    """Noise of the positions (k,), m, along each axis."""
    initial: Array
    """Mean error (k, seeds) of the trilaterated start, m."""
    relaxed: Array
    """Mean error (k, seeds, iterations), m, after ITERATIONS of the relaxation."""


def noisy_poses(
    data: Measurements, poses: Array, pairs: NDArray[np.int64], sigmas: Sequence[float], seeds: int
) -> NoisyPoses:
    """Errors at noise `sigmas` (k,), m, each with its own noise in every seed.

    data: readings of the taxels at the true `poses` (n, 4, 4); pairs (m, 2): rows of the taxels
    with a displacement between them. Taxels that eq. 15 does not place are left out.
    """
    errors = np.array([
        [_errors(data, poses, pairs, sigma, random_stream(seed, f"figure 9, level {level}"))
         for seed in range(seeds)]
        for level, sigma in enumerate(sigmas)
    ])  # fmt: skip
    return NoisyPoses(np.asarray(sigmas, dtype=float), errors[..., 0], errors[..., 1:])


def _errors(
    data: Measurements, poses: Array, pairs: NDArray[np.int64], sigma: float,
    rng: np.random.Generator,
) -> list[float]:  # fmt: skip
    """Mean errors, m: of the start, and after each of ITERATIONS."""
    noisy = replace(data, points=data.points + rng.normal(scale=sigma, size=data.points.shape))
    start = eq15.estimate(noisy, rng)
    rows = np.flatnonzero(start.found)
    linked = pairs[start.found[pairs].all(axis=1)]
    ends = perturbed(poses[linked], sigma, rng)
    measured = se3.inverse(ends[:, 0]) @ ends[:, 1]
    found = [se3.transform(poses[rows, :3, :3], start.points[rows])]
    edges = np.searchsorted(rows, linked)
    for done, until in pairwise((0, *ITERATIONS)):
        found.append(relaxed(found[-1], edges, measured, until - done))
    truth = poses[rows, :3, 3]
    return [
        float(np.linalg.norm(aligned(p[:, :3, 3], truth) - truth, axis=1).mean()) for p in found
    ]


def perturbed(poses: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Poses (..., 4, 4) with white noise of `sigma`, m, and of TURN sigma, rad."""
    turn = se3.exp_so3(rng.normal(scale=TURN * sigma, size=(*poses.shape[:-2], 3)))
    move = rng.normal(scale=sigma, size=(*poses.shape[:-2], 3))
    return np.asarray(se3.transform(poses[..., :3, :3] @ turn, poses[..., :3, 3] + move))


def relaxed(poses: Array, edges: np.ndarray, measured: Array, iterations: int) -> Array:
    """Poses (n, 4, 4) after `iterations`, in which each moves half way to the mean of the poses
    that its neighbours predict by the displacements T_i_j (m, 4, 4) along `edges` (m, 2).

    Source: Duckett, Marsland, Shapiro, "Learning globally consistent maps by relaxation" (ICRA
    2000); here all poses move at once.
    """
    source, goal = np.concatenate([edges, edges[:, ::-1]]).T
    step = np.concatenate([measured, se3.inverse(measured)])
    degree = np.bincount(goal, minlength=len(poses))[:, None, None]
    for _ in range(iterations):
        total = sums_by_group(poses[source] @ step, goal, len(poses))
        middle = 0.5 * (poses + np.where(degree, total / np.maximum(degree, 1), poses))
        u, _, v = np.linalg.svd(middle[:, :3, :3])  # the rotations nearest to the mean matrices
        poses = se3.transform(u @ v, middle[:, :3, 3])
    return poses


@dataclass(frozen=True)
class NoiseSweep:
    """Figure 9: initial against maximum-likelihood mean position errors, after rigid alignment."""

    sigmas: Array
    """Noise of the displacements (k,), m."""
    initial: Array
    """Mean error (k, seeds) of the start, m: displacements chained from the first taxel."""
    final: Array
    """Mean error (k, seeds) of the maximum-likelihood estimate, m; NaN where it is no minimum."""


def noise_sweep(
    poses: Array, pairs: NDArray[np.int64], initial_errors: Array, seeds: int, turn: float = TURN
) -> NoiseSweep:
    """Solve graphs whose initial estimates have mean errors `initial_errors` (k,), m.

    The initial estimate chains the displacements along a breadth-first tree from the first taxel.
    turn, rad/m: ratio of the rotation noise to the displacement noise. The noise of a seed is the
    same at every level, scaled.
    """
    truth = poses[:, :3, 3]

    def case(sigma: float, seed: int) -> tuple[float, float]:
        rng = random_stream(seed, "figure 9")
        graph = perturbed_graph(poses, pairs, sigma, turn * sigma, rng)
        solution = graph.solve(start="tree", keep_iterates=True)
        assert solution.iterates is not None
        first, last = (
            float(np.linalg.norm(aligned(p[:, :3, 3], truth) - truth, axis=1).mean())
            for p in (solution.iterates[0], solution.poses)
        )
        return first, last if solution.is_optimal else float("nan")

    unit = 1e-4
    gain = np.mean([case(unit, seed)[0] for seed in range(seeds)]) / unit
    sigmas = np.asarray(initial_errors, dtype=float) / gain
    errors = np.array([[case(float(s), seed) for seed in range(seeds)] for s in sigmas])
    return NoiseSweep(sigmas, errors[..., 0], errors[..., 1])
