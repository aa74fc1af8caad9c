"""The effect of each error source on the joint estimate of the paper's sphere, single and in pairs.

    python studies/effects.py --out figures/ [--scene sphere_noisy] [--seeds 2] [--full]

Each effect is on with its defaults and unknown to the estimator. Runs with and without it have the
same noise, so that the shift of the taxels is caused by the effect alone. The study prints for each
effect the mean error, the mean and largest shift, the bound that the effect states, E* relative to
its nominal value, the chi-square of the fit, and the readings rejected as outliers in percent
(including censored ones); it draws the shifts. --full: 5 seeds, and all pairs with the first of
them: the distance of the shift of both from the sum of the two shifts.

Shifts of pairs that do not add up differ mostly by the outlier rejection. `sampling` alone holds
each contact for two frames and is right in the first: 45 % of the readings of the second are
rejected, the others fit, and most of the shift vanishes. With `capacitive` too, no subset fits: the
model is judged wrong, most of those readings are kept, and the shift of `sampling` reappears.
Therefore every pair is also estimated without rejection; then the shifts of two effects nearly add
up to that of both.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import meshskin as ms
from meshskin import effects
from meshskin.core.atomic_io import write_json
from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import fault_detection
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.reduced_nlp import MAX_ITERATIONS
from meshskin.estimation.trilateration import coactivation, trilaterate
from meshskin.report import theme

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXTRA: dict[str, tuple[str, dict[str, float]]] = {
    "quantisation_16": ("quantisation", {"bits": 16}),
    "layer": ("layer", {"thickness_mm": 20.0}),
    "disc_averaging": ("disc_averaging", {"radius_mm": 1.5}),
    "joint_friction": ("joint_friction", {"torque_n_m": 0.05}),
}
"""Rows beside those of the effects that have defaults."""


class Found(NamedTuple):
    """What the estimator made of one scene, over seeds."""

    positions: np.ndarray
    """(seeds, n, 3), m."""
    modulus: float
    """E* over its nominal value."""
    chi2: float
    """Median of the taxels' chi-square per degree of freedom."""
    left_out: float
    """What is taken for outlying, silences too, in percent of the readings."""
    first: ms.Recording
    """What was recorded with the first seed."""


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Run the study; return its rows by name (a pair's: "one+other")."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--scene", default="sphere_noisy")
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--effects", nargs="*", default=None, help="only these")
    parser.add_argument("--pairs", action="store_true", help="all pairs too")
    parser.add_argument("--full", action="store_true", help="5 seeds, and pairs")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    seeds = range(options.seeds or (5 if options.full else 2))

    scene = ms.Scene.load(options.scene)
    known = {e.name for e in scene.effects}
    chosen = {
        name: make_effect(name)
        for name in options.effects or [*(e.name for e in effects.registered()), *EXTRA]
    }
    chosen = {name: effect for name, effect in chosen.items() if effect.name not in known}
    plain = simulate_and_calibrate(scene, (), seeds)
    single = {
        name: simulate_and_calibrate(scene, (effect,), seeds) for name, effect in chosen.items()
    }
    rows = {"(none)": effect_row(scene, plain, plain)}
    rows |= {name: effect_row(scene, plain, found) for name, found in single.items()}
    for name, effect in chosen.items():
        rows[name]["bound_mm"] = 1e3 * effect.bound(scene.context(0))
    print_table(rows, f"{options.scene}, {len(seeds)} seeds, lengths in mm")
    theme.save(draw_shifts(rows), options.out, "effects")
    if options.full or options.pairs:
        rows |= pair_rows(scene, chosen, plain, single, seeds[:1])
        theme.save(draw_excesses(rows, list(chosen)), options.out, "effect_pairs")
    if options.json:
        write_json(options.json, rows)
    return rows


def make_effect(name: str) -> effects.Effect:
    """An effect at its defaults, or one of EXTRA."""
    kind, fields = EXTRA.get(name, (name, {}))
    return effects.from_table({"kind": kind, **fields})


def simulate_and_calibrate(scene: ms.Scene, more: Sequence[effects.Effect], seeds: range) -> Found:
    """Simulate with more effects, and calibrate without knowing of them."""
    belief = scene.belief()
    world = scene.with_(effects=(*scene.effects, *more))
    recordings = [ms.simulate(world, seed) for seed in seeds]
    runs = [ms.calibrate(recording, belief) for recording in recordings]
    nominal = scene.material.effective_modulus
    return Found(
        np.stack([run.positions for run in runs]),
        float(np.mean([run.modulus for run in runs])) / nominal,
        float(np.mean([np.nanmedian(run.chi2) for run in runs])),
        float(np.mean([rejected_percent(run) for run in runs])),
        recordings[0],
    )


def rejected_percent(run: ms.Calibration) -> float:
    """Readings taken for outlying, silences too, in percent."""
    assert run.fit is not None  # a joint estimate has one
    return float(100 * run.fit.left_out / run.readings.sum())


def without_rejection(recording: ms.Recording, belief: ms.Belief) -> np.ndarray:
    """The joint estimate (n, 3), m, that takes no reading for outlying."""
    data, body = gather(recording, belief), belief.body
    near = coactivation.without_distant_readings(data)
    start = coactivation.initial_estimate(near, trilaterate.least_squares(near))
    live = np.setdiff1d(np.flatnonzero(start.found), fault_detection.stuck_taxels(data).rows)
    frames = chart.charts_at(body, start.points[live], start.rotations[live])
    places = SurfaceParametrization(frames, float(np.median(data.radii)) / 2)
    run = JointEstimator(data, live, places, np.ones(len(data.pressure)), MAX_ITERATIONS)
    run.converge()
    run.restart(trilaterate.centroids(near)[live])
    points = np.full(start.points.shape, np.nan)
    points[live] = run.problem.points(run.state)
    return points


def effect_row(scene: ms.Scene, plain: Found, found: Found) -> dict[str, float]:
    """The numbers of one scene beside those of the plain one."""
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=2)
    shift = np.linalg.norm(found.positions - plain.positions, axis=2)
    lost = np.isnan(error) & np.isfinite(plain.positions[..., 0])
    return {
        "error_mm": 1e3 * float(np.nanmean(error)),
        "shift_mm": 1e3 * float(np.nanmean(shift)),
        "median_mm": 1e3 * float(np.nanmedian(shift)),
        "largest_mm": 1e3 * float(np.nanmax(shift)),
        "lost": float(lost.sum(axis=1).mean()),
        "modulus": found.modulus,
        "chi2": found.chi2,
        "left_out": found.left_out,
    }


def pair_rows(
    scene: ms.Scene,
    chosen: dict[str, effects.Effect],
    plain: Found,
    single: dict[str, Found],
    seed: range,
) -> dict[str, dict[str, float]]:
    """Rows of all pairs: `excess_mm`, the median distance of their shift from the sum of the two,
    and `excess_from_all_mm`, the same where no reading is taken for outlying.
    """
    first, belief, rows = plain._replace(positions=plain.positions[:1]), scene.belief(), {}
    whole = {name: without_rejection(found.first, belief) for name, found in single.items()}
    none = without_rejection(plain.first, belief)
    for one, other in combinations(chosen, 2):
        two = chosen[one], chosen[other]
        if two[0].name == two[1].name or two[0].name in two[1].excludes:
            continue
        both = simulate_and_calibrate(scene, two, seed)
        parts = single[one], single[other]
        rows[f"{one}+{other}"] = effect_row(scene, first, both) | {
            "excess_mm": excess(*(p.positions[0] for p in (first, *parts, both))),
            "excess_from_all_mm": excess(
                none, whole[one], whole[other], without_rejection(both.first, belief)
            ),
            "left_out_one": parts[0].left_out,
            "left_out_other": parts[1].left_out,
        }
    if rows:
        worst = sorted(rows, key=lambda name: -rows[name]["excess_mm"])[:10]
        print("pairs that add up worst: median shift of both, median off the sum of the two, the")
        print("same with all readings taken (mm); readings left out of one, other, both (%)")
        for name in worst:
            r = rows[name]
            print(f"  {name:36}{r['median_mm']:9.4f}{r['excess_mm']:9.4f}"
                  f"{r['excess_from_all_mm']:9.4f}{r['left_out_one']:8.1f}"
                  f"{r['left_out_other']:6.1f}{r['left_out']:6.1f}")  # fmt: skip
    return rows


def excess(plain: np.ndarray, one: np.ndarray, other: np.ndarray, both: np.ndarray) -> float:
    """Median distance, mm, of the shift of both from the sum of the two: positions (n, 3), m."""
    return 1e3 * float(np.nanmedian(np.linalg.norm(both - one - other + plain, axis=1)))


def print_table(rows: dict[str, dict[str, float]], title: str) -> None:
    """Print the table, the largest shift first."""
    print(title)
    print(f"  {'effect':18}{'error':>9}{'shift':>9}{'median':>9}{'largest':>9}{'bound':>9}"
          f"{'E*':>8}{'chi2':>9}{'out %':>7}{'lost':>6}")  # fmt: skip
    for name in sorted(rows, key=lambda name: -rows[name]["shift_mm"]):
        r = rows[name]
        print(f"  {name:18}{r['error_mm']:9.4f}{r['shift_mm']:9.4f}{r['median_mm']:9.4f}"
              f"{r['largest_mm']:9.4f}{r.get('bound_mm', 0.0):9.3f}{r['modulus']:8.4f}"
              f"{r['chi2']:9.2f}{r['left_out']:7.1f}{r['lost']:6.1f}")  # fmt: skip


@theme.styled
def draw_shifts(rows: dict[str, dict[str, float]]) -> Figure:
    """Bars of the mean shift, with the largest and the bound, on a logarithmic scale."""
    names = sorted((n for n in rows if n != "(none)"), key=lambda name: rows[name]["shift_mm"])
    figure = theme.new_figure(6.4, 1.3 + 0.24 * len(names))
    axes = figure.add_subplot()
    place = np.arange(len(names))

    def column(key: str) -> np.ndarray:
        return np.array([rows[name][key] for name in names])

    axes.barh(place, column("shift_mm"), color=theme.ESTIMATE, height=0.6, label="mean shift")
    axes.plot(column("largest_mm"), place, "|", color=theme.INK, label="largest shift")
    axes.plot(column("bound_mm"), place, ".", color=theme.BOUND, label="stated bound")
    noise = rows["(none)"]["error_mm"]
    axes.axvline(noise, color=theme.MUTED, lw=0.8, zorder=0, label="mean error by noise alone")
    axes.set(xscale="log", xlabel="shift of the taxels (mm)")
    axes.set_title("Effects that the estimator does not know of")
    axes.set_yticks(place, [name.replace("_", " ") for name in names])
    figure.legend(loc="lower center", ncols=4)
    legend = 0.3 / figure.get_figheight()  # 0.3 inches
    figure.tight_layout(rect=(0.0, legend, 1.0, 1.0))
    return figure


@theme.styled
def draw_excesses(rows: dict[str, dict[str, float]], names: list[str]) -> Figure:
    """Map of how far pairs are from the sum of their shifts: below the diagonal as estimated, above
    it with no reading taken for outlying.
    """
    grid = np.full((len(names), len(names)), np.nan)
    for i, j in combinations(range(len(names)), 2):
        pair = rows.get(f"{names[i]}+{names[j]}")
        if pair:
            grid[j, i], grid[i, j] = pair["excess_mm"], pair["excess_from_all_mm"]
    figure = theme.new_figure(7.5, 6.8)
    axes = figure.add_subplot()
    image = axes.imshow(np.maximum(grid, 1e-5), norm="log", cmap=theme.SEQUENTIAL)
    labels = [name.replace("_", " ") for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=90)
    axes.set_yticks(range(len(names)), labels)
    axes.set_title("Two effects together: how far from the sum of their shifts")
    axes.set_xlabel(
        "below the diagonal: as estimated; above it: all readings taken, none as outlying"
    )
    figure.colorbar(image, ax=axes, label="median of the taxels (mm)", shrink=0.8)
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
