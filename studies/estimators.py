"""All estimators on the same recordings, over noise, initial error and size of the skin.

    python studies/estimators.py --out figures/ [--seeds N] [--only noise start size] [--full]

noise   the paper's sphere with the contacts of its own exploration, sensor noise of 0.1 to 20 % of
        the peak pressure, and a threshold of three standard deviations (at least 5 %): mean
        position error of each method relative to the Cramér-Rao bound, and the share of the
        improvement that the correct information matrices give over the paper's isotropic ones at
        5 % noise.
start   initial errors of 0.5 to 12 mm: share of taxels (joint) and of runs (pose graph) that end at
        the optimum, also for Gauss-Newton steps of the joint estimate without restarts, and for a
        start from co-activation alone.
size    20 to 500 taxels (2,000 with --full) of equal density: error over bound, and seconds.

Three seeds, ten with --full. The pose graph leaves a rigid motion undetermined; it is compared up
to that.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

import meshskin as ms
from meshskin.core import se3
from meshskin.core.atomic_io import write_json
from meshskin.core.errors import MeshskinError
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.estimation import chart
from meshskin.estimation.calibrate import METHODS
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.measurements import Measurements
from meshskin.estimation.joint import maximum_likelihood
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.reduced_nlp import MAX_ITERATIONS
from meshskin.estimation.result import EstimatorResult
from meshskin.estimation.trilateration import coactivation, displacements, trilaterate
from meshskin.estimation.uncertainty import metrics
from meshskin.report import theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOISE = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2)
START_MM = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
SIZES, LARGE = (20, 80, 200, 500), 2000
SPACING, PRESSES = 5e-3, 14
"""Distance of taxels, m, and contacts a taxel, of the skins of other sizes."""
SAME = 1e-6
"""Distance from the optimum, m, and difference of cost, relative, that count as reached."""
WORDS = {
    "eq15": "eq. 15 as printed, three random circles",
    "three_circles": "three chosen circles",
    "trilateration": "all circles",
    "posegraph_paper": "pose graph of chosen circles, isotropic",
    "posegraph_isotropic": "pose graph, isotropic information",
    "posegraph": "pose graph, right information",
    "joint": "joint estimate",
    "centroid": "centroid of contact points",
}


def with_noise(scene: ms.Scene, noise: float) -> ms.Scene:
    """The scene with so much noise, read above three standard deviations of it."""
    readout = ms.Readout(threshold_relative=max(0.05, 3 * noise))
    return scene.with_(effects=(GaussianNoise(noise),), readout=readout)


def compare(scene: ms.Scene, points: np.ndarray, seeds: range) -> dict[str, float]:
    """Mean error (mm), bound (mm), seconds, and the joint NEES; NaN where a method gives up."""
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    seconds, bounds, nees = dict.fromkeys(METHODS, 0.0), [], []
    belief = scene.belief()
    for seed in seeds:
        recording = ms.press(scene, points, seed=seed)
        bounds.append(1e3 * metrics.cramer_rao(recording, belief, scene.skin).mean)
        for method in METHODS:
            clock, free = process_time(), method.startswith("posegraph")
            try:
                found = ms.calibrate(recording, belief, method=method)
                seconds[method] += (process_time() - clock) / len(seeds)
                off = metrics.position_errors(found, scene.skin, gauge=free)
            except MeshskinError:
                errors[method].append(np.nan)
                continue
            errors[method].append(1e3 * float(np.nanmean(off)))
            if method == "joint":
                nees.append(float(np.nanmean(metrics.nees(found, scene.skin))))
    row = {name: float(np.mean(values)) for name, values in errors.items()}
    row |= {f"{name}_s": value for name, value in seconds.items()}
    return row | {"bound": float(np.mean(bounds)), "nees": float(np.mean(nees))}


def by_noise(points: np.ndarray, seeds: range, levels: tuple[float, ...]) -> dict[str, dict]:
    """Rows of the noise levels."""
    scene = ms.Scene.load("sphere")
    rows = {f"{level:g}": compare(with_noise(scene, level), points, seeds) for level in levels}
    low, high = metrics.nees_band(len(seeds) * len(scene.skin))
    print(f"mean error over the bound's expectation, {len(seeds)} seeds, {len(points)} contacts")
    heads = "".join(f"{float(key):8.1%}" for key in rows)
    print(f"  {'noise':44}{heads}")
    for name, words in WORDS.items():
        print(f"  {words:44}" + "".join(f"{r[name] / r['bound']:8.2f}" for r in rows.values()))
    print(f"  {'bound (mm)':44}" + "".join(f"{r['bound']:8.4f}" for r in rows.values()))
    print(f"  {f'NEES (95 %: {low:.2f} to {high:.2f})':44}"
          + "".join(f"{r['nees']:8.2f}" for r in rows.values()))  # fmt: skip
    if "0.05" in rows:
        r = {name: rows["0.05"][name] / rows["0.05"]["joint"] for name in WORDS}
        won = (r["posegraph_isotropic"] - r["posegraph"]) / (r["posegraph_isotropic"] - 1)
        print(f"  at 5 %: three chosen circles {r['three_circles']:.1f} times the joint error, "
              f"isotropic pose graph {r['posegraph_isotropic']:.1f} times; the right information "
              f"matrices alone win back {won:.0%} of that")  # fmt: skip
    return rows


def by_start(points: np.ndarray, seeds: range, levels: tuple[float, ...]) -> dict[str, dict]:
    """Rows of the initial errors, at 1 % noise; "co-activation" last."""
    scene = with_noise(ms.Scene.load("sphere"), 0.01)
    rows: dict[str, list[dict[str, float]]] = {}
    for seed in seeds:
        data = gather(ms.press(scene, points, seed=seed), scene.belief())
        right = trilaterate.least_squares(data)
        best = maximum_likelihood.optimum(data).result().points
        measured = displacements.SharedContacts(data, right).displacements()
        graph = measured.graph(right, data.ids)
        least = graph.solve().cost
        rng = np.random.default_rng(seed)
        for level in levels:
            fit = displaced_points(scene, right, best, 1e-3 * level, rng)
            poses = se3.transform(fit.rotations, fit.points)
            graph_cost = graph.solve(start=poses).cost
            row = optimum_shares(data, scene, fit, best) | {"error_mm": level}
            row["posegraph"] = float(abs(graph_cost / least - 1) < SAME)
            rows.setdefault(f"{level:g}", []).append(row)
        alone = coactivation.contact_centroid_start(data)
        off = 1e3 * float(np.linalg.norm(alone.points - best, axis=1).mean())
        row = optimum_shares(data, scene, alone, best) | {"error_mm": off}
        rows.setdefault("co-activation", []).append(row)
    means = {
        key: {name: float(np.mean([r[name] for r in many])) for name in many[0]}
        for key, many in rows.items()
    }
    print(f"share at the optimum from an initial error, {len(seeds)} seeds")
    print("  start (mm)          joint   its steps alone   pose graph")
    for key, r in means.items():
        label = f"{r['error_mm']:.2f}" + (f" ({key})" if key == "co-activation" else "")
        graph_share = f"{r['posegraph']:10.0%}" if "posegraph" in r else ""
        print(f"  {label:20}{r['joint']:5.0%}{r['plain']:18.0%}   {graph_share}")
    return means


def displaced_points(
    scene: ms.Scene,
    right: EstimatorResult,
    points: np.ndarray,
    distance: float,
    rng: np.random.Generator,
) -> EstimatorResult:
    """`right` with its points (n, 3) moved by `distance`, m, each in a direction of its own."""
    angle = rng.uniform(-np.pi, np.pi, (len(points), 1))
    x, y = np.moveaxis(right.rotations[:, :, :2], 2, 0)
    hit = scene.body.closest(points + distance * (np.cos(angle) * x + np.sin(angle) * y))
    rotations = chart.align_normals(right.rotations, hit.normal)
    return replace(right, points=hit.point, rotations=rotations)


def optimum_shares(
    data: Measurements, scene: ms.Scene, start: EstimatorResult, best: np.ndarray
) -> dict[str, float]:
    """Share of taxels that end at their `best` places, and without restarts; 0 where one fails."""

    def share(estimate: Callable[[], np.ndarray]) -> float:
        try:
            return float(np.mean(np.linalg.norm(estimate() - best, axis=1) < SAME))
        except MeshskinError:
            return 0.0

    return {
        "joint": share(lambda: maximum_likelihood.optimum(data, start).result().points),
        "plain": share(lambda: steps_only(data, scene, start)),
    }


def steps_only(data: Measurements, scene: ms.Scene, start: EstimatorResult) -> np.ndarray:
    """Points (n, 3) of the joint estimate without restarts and without doubt."""
    live, step = np.flatnonzero(start.found), float(np.median(data.radii)) / 2
    places = SurfaceParametrization(
        chart.charts_at(scene.body, start.points[live], start.rotations[live]), step
    )
    run = JointEstimator(data, live, places, np.ones(len(data.pressure)), MAX_ITERATIONS)
    run.converge()
    return run.problem.points(run.state)


def by_size(seeds: range, sizes: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """Rows of skins of other sizes, at 5 % noise."""
    rows = {}
    for size in sizes:
        scene, points = scaled_scene(size)
        rows[str(size)] = compare(with_noise(scene, 0.05), points, seeds)
    print(f"mean error over the bound's expectation at 5 % noise, {PRESSES} contacts a taxel; "
          "processor seconds")  # fmt: skip
    print(f"  {'taxels':44}" + "".join(f"{size:>16}" for size in rows))
    for name, words in WORDS.items():
        cells = (f"{r[name] / r['bound']:8.2f}{r[name + '_s']:7.2f} s" for r in rows.values())
        print(f"  {words:44}" + "".join(cells))
    return rows


def scaled_scene(taxels: int) -> tuple[ms.Scene, np.ndarray]:
    """The paper's scene with a larger or smaller skin, on a sphere that grows with it; contacts."""
    radius = max(0.1, SPACING * np.sqrt(taxels / np.pi))
    body = ms.Body.sphere(radius)
    hit = body.closest(spiral(taxels, taxels, radius))
    poses = se3.transform(chart.frames(hit.normal), hit.point)
    scene = ms.Scene.load("sphere")
    skin = ms.Skin(poses, np.arange(taxels), scene.skin.disc_radius)
    return scene.with_(body=body, skin=skin), spiral(PRESSES * taxels, taxels * 1.15, radius)


def spiral(n: int, taxels: float, radius: float) -> np.ndarray:
    """n points (n, 3), m, evenly over the cap that so many taxels cover at a sphere's bottom."""
    k = np.arange(n) + 0.5
    height = 1 - taxels * SPACING**2 * np.sqrt(0.75) / (2 * np.pi * radius**2) * k / n
    angle = np.pi * (3 - np.sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    return radius * np.column_stack([ring * np.cos(angle), ring * np.sin(angle), -height])


@theme.styled
def draw(found: dict[str, dict[str, dict[str, float]]]) -> Figure:
    """One panel a sweep that was run."""
    figure = theme.new_figure(5.0 * len(found), 4.2)
    for axes, (sweep, rows) in zip(
        figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True
    ):
        if sweep == "start":
            rows = {key: r for key, r in rows.items() if key != "co-activation"}
            x = [r["error_mm"] for r in rows.values()]
            curves = {"joint": "joint estimate", "plain": "its steps alone"}
            curves["posegraph"] = "pose graph"
            for key, words in curves.items():
                y = [100 * r[key] for r in rows.values()]
                axes.plot(x, y, "o-", ms=3, color=theme.method_colour(key), label=words)
            axes.set(xlabel="initial error (mm)", ylabel="at the optimum (%)")
            axes.set_title("From how far the optimum is found")
        else:
            x = [100 * float(key) if sweep == "noise" else float(key) for key in rows]
            for key, words in WORDS.items():
                y = [r[key] / r["bound"] for r in rows.values()]
                axes.plot(x, y, "o-", ms=3, color=theme.method_colour(key), label=words)
            axes.axhline(1.0, color=theme.MUTED, lw=0.8)
            axes.set(xscale="log", yscale="log", ylabel="mean error over the bound")
            axes.set_ylim(top=15 * axes.get_ylim()[1])  # room for the legend
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.minorticks_off()
            axes.set_xlabel("noise (% of the peak)" if sweep == "noise" else "taxels")
            axes.set_title("Accuracy over " + ("noise" if sweep == "noise" else "size, 5 % noise"))
        axes.legend(fontsize=7)
    figure.tight_layout()
    return figure


def main(arguments: list[str] | None = None) -> dict[str, dict[str, dict[str, float]]]:
    """Run the sweeps; return their rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--only", nargs="+", choices=("noise", "start", "size"), default=None)
    parser.add_argument("--full", action="store_true", help="ten seeds, and 2,000 taxels")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    seeds = range(options.seeds or (10 if options.full else 3))
    sizes = (*SIZES, LARGE) if options.full else SIZES
    chosen = options.only or ("noise", "start", "size")

    found: dict[str, dict[str, dict[str, float]]] = {}
    path = ms.simulate(ms.Scene.load("sphere")).points if chosen != ["size"] else np.zeros((0, 3))
    if "noise" in chosen:
        found["noise"] = by_noise(path, seeds, NOISE)
    if "start" in chosen:
        found["start"] = by_start(path[::3], seeds, START_MM)
    if "size" in chosen:
        found["size"] = by_size(seeds, sizes)
    theme.save(draw(found), options.out, "estimators")
    if options.json:
        write_json(options.json, found)
    return found


if __name__ == "__main__":
    main()
