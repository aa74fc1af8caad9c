"""Seconds to solve a pose graph of taxels, compared with GTSAM on the same graphs and start.

    python studies/speed/pose_graph.py [taxels ...] [--full] [--repeats 3] [--out DIR]

Graphs: taxels 5 mm apart on a sphere, each with the displacements to its nine nearest neighbours,
with noise of 1 mm and 0.02 rad. Both solvers start from our chordal start; GTSAM runs Gauss-Newton
with METIS ordering and its default tolerances. Times are processor seconds (one thread each), the
best of the repeats, interleaved:

    solve     IPOPT with the check of its result; NLP and elimination order known before
    all       a new graph from its arrays: checks, building, start and solve
    again     a new graph of a topology that was solved before: start and solve
    optimize  GTSAM's `optimize()` alone
    gtsam all GTSAM's factor graph and values from the same arrays, and `optimize()`

The ratios that are judged divide by `optimize`, the stricter one; those to `gtsam all` are printed,
too. The exit code is 1 if one misses its target. --full: 50,000 taxels, too, without GTSAM.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import resource
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import process_time
from typing import TypeVar

import numpy as np
import results
from scipy.spatial import cKDTree

from meshskin import PoseGraph
from meshskin.core import se3
from meshskin.estimation.posegraph import problem
from meshskin.estimation.posegraph.edge_assembly import library
from meshskin.estimation.posegraph.start import chordal

T = TypeVar("T")

SPACING = 5e-3
NEIGHBOURS = 9
SIGMA = np.array([1e-3] * 3 + [0.02] * 3)
SIZES = (80, 500, 2000, 10_000)
LARGE = 50_000
SOLVE = {80: 1.1, 500: 0.9, 2000: 0.75, 10_000: 0.65}
"""Targets of solve / optimize."""
ALL, AGAIN, JUDGED = 1.5, 1.0, (2000, 10_000)
"""Targets of all / optimize and again / optimize, and the sizes where they are judged."""
MARGINALS = {10_000: 3.0}  # s
GROWTH, MEMORY = 1.4, 6.0  # exponent from 2,000 to 50,000 taxels, GB at 50,000


@dataclass(frozen=True)
class Row:
    """Seconds of one size, and what was found."""

    taxels: int
    edges: int
    solve: float
    all: float
    again: float
    optimize: float
    gtsam_all: float
    marginals: float
    proof: float
    gap: float
    solve_gb: float
    """Peak memory of the process after solving; `peak_gb` after marginals and proof, too."""
    peak_gb: float
    iterations: int
    gtsam_iterations: int
    cost_off: float
    """Our cost over GTSAM's, less 1."""


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

    def optimize() -> tuple[float, int]:
        optimizer = gtsam.GaussNewtonOptimizer(factors, values, parameters)
        optimizer.optimize()
        return optimizer.error(), optimizer.iterations()

    return optimize


def timed(function: Callable[[], T]) -> tuple[float, T]:
    began = process_time()
    result = function()
    return process_time() - began, result


def measure(taxels: int, repeats: int, peer: bool) -> Row:
    """Time one size; without `peer`, GTSAM's numbers are NaN."""
    graph = skin_graph(taxels)
    arrays = graph.poses, graph.edges, graph.measurements, graph.information
    start = chordal(graph)
    seconds = []
    cost, iterations, theirs, built = np.nan, 0, np.nan, np.nan
    for _ in range(repeats):
        problem.topology_cache = problem.TopologyCache(edges=2 * len(graph.edges))  # nothing known
        everything, _ = timed(lambda: PoseGraph(*arrays).solve())
        known = PoseGraph(*arrays)
        again, _ = timed(known.solve)
        ours = graph.solve(start=start)
        solve, ours = timed(lambda: graph.solve(start=start))
        if peer:
            built, run = timed(lambda: gtsam_solver(graph, start))
            theirs, (cost, iterations) = timed(run)
        seconds.append((solve, everything, again, theirs, built + theirs))
    solve, everything, again, theirs, built = np.min(seconds, axis=0).tolist()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2  # of solving
    marginals, _ = timed(ours.covariances)
    proof, certificate = timed(lambda: ours.certificate)
    whole = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    return Row(
        taxels, len(graph.edges), solve, everything, again, theirs, built, marginals, proof,
        certificate.relative_gap, memory, whole, ours.iterations, iterations, ours.cost / cost - 1,
    )  # fmt: skip


def show(row: Row) -> None:
    print(
        f"{row.taxels:7d} {row.edges:7d} {row.solve:8.4f} {row.all:8.4f} {row.again:8.4f}"
        f" {row.optimize:8.4f} {row.gtsam_all:9.4f} {row.all / row.gtsam_all:8.2f}"
        f" {row.again / row.gtsam_all:8.2f} {row.marginals:9.3f} {row.proof:7.3f} {row.gap:7.0e}"
        f" {row.solve_gb:8.2f} {row.peak_gb:7.2f} {row.iterations:2d}/{row.gtsam_iterations}"
        f" {row.cost_off:8.0e}",
        flush=True,
    )


def judged(rows: list[Row]) -> list[tuple[str, float, float]]:
    """(what, value, target) of everything that has a target; at most the target is good."""
    found, by_size = [], {row.taxels: row for row in rows}
    for n, row in by_size.items():
        if n in SOLVE:
            found.append((f"solve / optimize at {n}", row.solve / row.optimize, SOLVE[n]))
        if n in JUDGED:
            found.append((f"all / optimize at {n}", row.all / row.optimize, ALL))
            found.append((f"again / optimize at {n}", row.again / row.optimize, AGAIN))
        if n in MARGINALS:
            found.append((f"marginals at {n}, s", row.marginals, MARGINALS[n]))
    if LARGE in by_size:
        found.append((f"peak memory, solving {LARGE}, GB", by_size[LARGE].solve_gb, MEMORY))
        found.append((f"peak memory, all at {LARGE}, GB", by_size[LARGE].peak_gb, MEMORY))
        if 2000 in by_size:
            small, large = by_size[2000], by_size[LARGE]
            span = np.log(LARGE / 2000)
            for name in ("solve", "all"):
                power = np.log(getattr(large, name) / getattr(small, name)) / span
                found.append((f"growth of {name}, 2000 to {LARGE}", float(power), GROWTH))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("taxels", type=int, nargs="*", default=list(SIZES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--full", action="store_true", help=f"{LARGE} taxels, too")
    results.add_out(parser)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    for residual in ("log", "vec"):
        library(residual)  # compiled once per machine, loaded once per process
    skin_graph(80).solve()  # IPOPT and its BLAS, loaded once per process
    print(
        " taxels   edges    solve      all    again optimize gtsam all all/all  again/all"
        " marginals   proof     gap GB solve GB peak iterations cost"
    )
    rows = []
    for taxels in arguments.taxels + [LARGE] * arguments.full:
        large = taxels >= LARGE
        rows.append(measure(taxels, 1 if large else arguments.repeats, not large))
        show(rows[-1])
    table = judged(rows)
    print()
    for what, value, target in table:
        verdict = "reached" if value <= target else "FALLS SHORT"
        print(f"{what:32s} {value:7.3f}  at most {target:5.2f}  {verdict}")
    report = {
        "rows": [asdict(row) for row in rows],
        "judged": [{"what": w, "value": v, "target": t} for w, v, t in table],
    }
    shown = {
        f"{row.taxels:,} taxels": {
            name: getattr(row, name) / row.optimize for name in ("solve", "all", "again")
        }
        for row in rows
    }
    label = "processor time / that of GTSAM's optimize()"
    results.write(arguments.out, "pose_graph", report, shown, label, {"GTSAM": 1.0})
    return 1 if any(value > target for _, value, target in table) else 0


if __name__ == "__main__":
    sys.exit(main())
