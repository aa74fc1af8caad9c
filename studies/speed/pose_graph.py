"""How fast a pose graph of taxels is solved, beside GTSAM: same graphs, start, run; one core each.

    python studies/speed/pose_graph.py [taxels ...]

Graphs: taxels 5 mm apart on a sphere, each with the displacements to its nine nearest neighbours,
1 mm and 0.02 rad of noise. Both start from our chordal start; GTSAM runs Gauss-Newton with METIS
ordering at its default tolerances. Seconds are the best of the repeats, interleaved:

    solve   IPOPT with the check of its result, NLP built before;  gtsam   `optimize()` alone
    all     building, start and solve for a new graph;  again   the same for known topology
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import resource
from collections.abc import Callable
from time import perf_counter

import numpy as np
from scipy.spatial import cKDTree

from meshskin import PoseGraph, se3
from meshskin.estimation.posegraph.sweep import library
from meshskin.estimation.posegraph.start import chordal

SPACING = 5e-3
NEIGHBOURS = 9
SIGMA = np.array([1e-3] * 3 + [0.02] * 3)


def skin_graph(taxels: int, seed: int = 0) -> PoseGraph:
    """A sphere covered with taxels, their z axes outward, and noisy displacements."""
    rng = np.random.default_rng(seed)
    radius = SPACING * np.sqrt(taxels * np.sqrt(0.75) / (4 * np.pi))
    k = np.arange(taxels) + 0.5
    z, angle = 1 - 2 * k / taxels, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    normals = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    tangents = np.cross(rng.normal(size=(taxels, 3)), normals)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    rotations = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    truth = se3.transform(rotations, radius * normals)
    nearest = cKDTree(normals).query(normals, NEIGHBOURS + 1)[1][:, 1:]
    edges = np.stack([np.repeat(np.arange(taxels), NEIGHBOURS), nearest.ravel()], axis=1)
    noise = SIGMA * rng.normal(size=(len(edges), 6))
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    measured[:, :3, 3] += noise[:, :3]
    measured[:, :3, :3] = measured[:, :3, :3] @ se3.exp_so3(noise[:, 3:])
    return PoseGraph(truth, edges, measured, np.diag(SIGMA**-2))


def gtsam_solver(graph: PoseGraph, start: np.ndarray) -> Callable[[], tuple[float, int]]:
    """GTSAM's Gauss-Newton on the same graph: a function that solves it -> cost, iterations."""
    import gtsam

    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    model = gtsam.noiseModel.Diagonal.Sigmas(SIGMA[[3, 4, 5, 0, 1, 2]])  # rotation first
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)  # constrained would force a slow QR
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(graph.poses[0]), held))
    for (i, j), measured in zip(graph.edges.tolist(), graph.measurements, strict=True):
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(measured), model))
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose3(pose))
    parameters = gtsam.GaussNewtonParams()
    parameters.setOrderingType("METIS")

    def optimise() -> tuple[float, int]:
        optimiser = gtsam.GaussNewtonOptimizer(factors, values, parameters)
        optimiser.optimize()
        return optimiser.error(), optimiser.iterations()

    return optimise


def timed(function: Callable[[], object]) -> tuple[float, object]:
    began = perf_counter()
    result = function()
    return perf_counter() - began, result


def measure(taxels: int, repeats: int) -> None:
    """Time one size, and print its row."""
    graph = skin_graph(taxels)
    start = chordal(graph)
    peer = gtsam_solver(graph, start)
    rows = []
    for _ in range(repeats):
        fresh = PoseGraph(graph.poses, graph.edges, graph.measurements, graph.information)
        everything, _ = timed(fresh.solve)
        again, _ = timed(fresh.solve)
        ours = fresh.solve(start=start)
        theirs, (cost, iterations) = timed(peer)
        rows.append((everything, again, ours.solve_time, theirs))
    everything, again, solve, theirs = np.min(rows, axis=0)
    marginals, _ = timed(ours.covariances)
    proof, certificate = timed(lambda: ours.certificate)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{taxels:7d} {len(graph.edges):7d} {solve:8.4f} {theirs:8.4f} {solve / theirs:6.2f}"
        f" {everything:8.4f} {everything / theirs:6.2f} {again:8.4f} {again / theirs:6.2f}"
        f" {marginals:9.3f} {proof:7.3f} {certificate.relative_gap:7.0e} {memory:7.0f}"
        f" {ours.iterations:2d}/{iterations} {ours.cost / cost - 1:8.0e}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("taxels", type=int, nargs="*", default=[80, 500, 2000, 10000])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    for residual in ("log", "vec"):
        library(residual)  # compiled once per machine, loaded once per process
    print(
        " taxels   edges    solve    gtsam  ratio      all  ratio    again  ratio"
        " marginals   proof     gap  MB peak iterations cost"
    )
    for taxels in arguments.taxels:
        measure(taxels, arguments.repeats)


if __name__ == "__main__":
    main()
