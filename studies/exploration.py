"""Number of contacts against error: fixed lanes and adaptive exploration.

    python studies/exploration.py --out figures/ [--scene ellipsoid] [--pitch-mm 5 6.5] [--seeds 3]
                                  [--full]

Both explore the same skin at each pitch: 5 mm as in the paper, 6.5 mm as in iCub's modules. A
contact is one reading of the whole skin at rest at the reference force. Fixed lanes have the
scene's spacing, and contacts at steps of 0.5 mm (100 Hz at 50 mm/s) to 1 mm along them. Adaptive
exploration makes a sparse first pass, then rounds of `Calibration.next_contacts`.

The study prints, at the mean errors of the lanes, the ratio of the contacts that adaptive
exploration needs to those of the lanes: as measured; by the Cramér-Rao bound at the contacts made,
which is free of noise (the measured ratio scatters by 0.03 with 12 seeds); the lower limit of any
design (contact_design.py, which knows the taxels' positions); and the measured ratio for the
largest stated uncertainty. It draws the curves. --full: 12 seeds, and one adaptive run through the
closed loop with the arm.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import contact_design
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import meshskin as ms
from meshskin.core.atomic_io import write_json
from meshskin.estimation.adaptive import adapt
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.report import theme
from meshskin.simulation.contact_samplers import closed_loop_sampler

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEPS = (1e-3, 0.7e-3, 0.5e-3)
"""Distances of contacts along the fixed lanes, m."""
LEVELS = 9
"""Errors, between those of the lanes, at which the two are compared."""
MARGIN = 1.3
"""Part of the lanes' largest error up to which rounds of adaptive exploration are taken."""
AIM = 12e-6
"""Target of every taxel's uncertainty in the adaptive runs, m: about what the lanes reach."""
Curve = dict[str, np.ndarray]
"""contacts, error_mm (mean over taxels and seeds), sigma_mm (worst taxel's, mean over seeds),
expected_mm (mean error by the bound)"""
COMPARED = {"error_mm": "ratio", "expected_mm": "expected_ratio", "sigma_mm": "worst_ratio"}


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Run the study; return its rows by pitch."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--scene", default="ellipsoid")
    parser.add_argument("--pitch-mm", type=float, nargs="+", default=[5.0, 6.5])
    parser.add_argument("--count", type=int, default=None, help="taxels; the scene's by default")
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--full", action="store_true", help="12 seeds, and the closed loop")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    seeds = range(options.seeds or (12 if options.full else 3))

    rows, curves = {}, {}
    for pitch in options.pitch_mm:
        scene = with_pitch(ms.Scene.load(options.scene), pitch * 1e-3, options.count)
        fixed, least = lane_curve(scene, seeds), optimal_error(scene)
        adaptive = adaptive_curve(scene, seeds, int(fixed["contacts"].max()))
        rows[f"{pitch:g}"] = contact_ratios(fixed, adaptive) | {
            "floor": smallest_ratio(fixed, least)
        }
        curves[f"{pitch:g}"] = fixed, adaptive, least
    report(rows, f"{options.scene}, {len(seeds)} seeds: adaptive contacts over those of lanes")
    if options.full:
        rows["closed loop"] = through_the_loop(ms.Scene.load(options.scene))
    theme.save(draw_curves(curves), options.out, "exploration")
    if options.json:
        write_json(options.json, rows)
    return rows


def with_pitch(scene: ms.Scene, pitch: float, count: int | None = None) -> ms.Scene:
    """The scene with its skin laid again, its taxels `pitch` (m) apart about the same middle."""
    middle = scene.skin.positions.mean(axis=0) - scene.body.mesh.bounds.mean(axis=0)
    region = Cap(tuple(middle))
    skin = ms.Skin.cover(scene.body, count=count or len(scene.skin), spacing=pitch, region=region)
    return scene.with_(skin=skin)


def lane_contacts(scene: ms.Scene) -> list[np.ndarray]:
    """Contacts (k, 3) of fixed lanes, at each of the steps along them."""
    dense = replace(scene.exploration, pattern="lanes")
    free = replace(scene.loop, mode="quasi_static")
    path = plan_exploration(scene.with_(exploration=dense, loop=free)).path.points
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return [path[np.searchsorted(along, np.arange(0.0, along[-1], step))] for step in STEPS]


def lane_curve(scene: ms.Scene, seeds: range) -> Curve:
    """The curve of fixed lanes."""
    belief = scene.belief()
    found: list[tuple[float, ...]] = []
    for points in lane_contacts(scene):
        runs = [ms.calibrate(ms.press(scene, points, seed=seed), belief) for seed in seeds]
        errors = [error_mm(scene, run.positions) for run in runs]
        worst = [1e3 * run.position_sigma.max() for run in runs]
        mean, widest = float(np.mean(errors)), float(np.mean(worst))
        found.append((len(points), mean, widest, expected_mm(scene, points)))
    return sorted_curve(found)


def optimal_error(scene: ms.Scene) -> float:
    """Mean error, mm, times the root of the number of contacts, that no design is below."""
    belief, reach = scene.belief(), scene.rig.sensing_radius
    return 1e3 * contact_design.optimal_design(belief, scene.skin.positions, reach).bound


def smallest_ratio(fixed: Curve, least: float) -> float:
    """Part of the lanes' contacts that the best of all designs needs for the error they leave."""
    needed = (least / fixed["expected_mm"]) ** 2 / fixed["contacts"]
    return float(np.exp(np.log(needed).mean()))


def adaptive_curve(scene: ms.Scene, seeds: range, most: int) -> Curve:
    """The curve of adaptive exploration with at most so many contacts."""
    found: dict[int, list[tuple[float, float, float]]] = {}
    for seed in seeds:
        run = adapt(scene, AIM, seed=seed, most=most)
        for one in run.rounds:
            if np.isfinite(one.positions).all():
                made = run.recording.points[: one.contacts]
                errors = error_mm(scene, one.positions), 1e3 * one.worst_sigma
                found.setdefault(one.contacts, []).append((*errors, expected_mm(scene, made)))
    whole = {k: np.mean(v, axis=0) for k, v in found.items() if len(v) == len(seeds)}
    return sorted_curve([(k, *whole[k]) for k in sorted(whole)])


def sorted_curve(found: list[tuple[float, ...]]) -> Curve:
    """A curve from its points."""
    columns = np.array(found, dtype=float).T
    return dict(zip(("contacts", "error_mm", "sigma_mm", "expected_mm"), columns, strict=True))


def expected_mm(scene: ms.Scene, points: np.ndarray) -> float:
    """Mean error, mm, that the bound lets one expect of contacts at points (k, 3)."""
    return 1e3 * contact_design.expected_error(scene.belief(), scene.skin.positions, points)


def error_mm(scene: ms.Scene, positions: np.ndarray) -> float:
    """Mean distance, mm, from the true taxels."""
    return 1e3 * float(np.linalg.norm(positions - scene.skin.positions, axis=1).mean())


def contact_ratios(fixed: Curve, adaptive: Curve) -> dict[str, float]:
    """Contacts of adaptive over those of lanes, at equal mean error and at equal worst sigma."""
    row: dict[str, float] = {}
    for key, name in COMPARED.items():
        levels = np.geomspace(fixed[key].min(), fixed[key].max(), LEVELS)
        near = adaptive[key] <= MARGIN * levels[-1]
        needed = contacts_needed({k: v[near] for k, v in adaptive.items()}, key, levels)
        ratio = needed / contacts_needed(fixed, key, levels)
        row |= {name: float(np.exp(np.log(ratio).mean()))}
        row |= {f"{name}_low": float(ratio.min()), f"{name}_high": float(ratio.max())}
    return row


def contacts_needed(one: Curve, key: str, levels: np.ndarray) -> np.ndarray:
    """Contacts at which a curve falls to the levels, by the straight line through its logarithms:
    errors go with a power of the contacts, and a line forgives the luck of single points."""
    slope, start = np.polyfit(np.log(one[key]), np.log(one["contacts"]), 1)
    return np.exp(start + slope * np.log(levels))


def through_the_loop(scene: ms.Scene) -> dict[str, float]:
    """One adaptive run in which the arm makes every touch."""
    found = adapt(scene, 30e-6, touch=closed_loop_sampler)
    error = error_mm(scene, found.calibration.positions)
    print(f"closed loop, target 0.03 mm: {len(found.recording.time)} touches in "
          f"{len(found.rounds)} rounds, mean error {error:.4f} mm, "
          f"{len(found.unmet)} taxels above the target")  # fmt: skip
    return {"contacts": float(len(found.recording.time)), "error_mm": error}


def report(rows: dict[str, dict[str, float]], title: str) -> None:
    """Print the table."""
    print(title)
    print(
        f"  {'pitch, mm':>10} {'at equal mean error':>24} {'by the bound':>24} "
        f"{'no choice is below':>20} {'at equal worst sigma':>24}"
    )
    for pitch, r in rows.items():
        mean, expected, worst = (
            f"{r[name]:.2f} ({r[f'{name}_low']:.2f} to {r[f'{name}_high']:.2f})"
            for name in COMPARED.values()
        )
        print(f"  {pitch:>10} {mean:>24} {expected:>24} {r['floor']:>20.2f} {worst:>24}")


@theme.styled
def draw_curves(curves: dict[str, tuple[Curve, Curve, float]]) -> Figure:
    """Mean error against contacts, a panel a pitch, and the line that no design is below."""
    figure = theme.new_figure(3.6 * len(curves), 3.2)
    for k, (pitch, (fixed, adaptive, least)) in enumerate(curves.items()):
        axes = figure.add_subplot(1, len(curves), k + 1)
        axes.loglog(fixed["contacts"], fixed["error_mm"], "s-", color=theme.MUTED, label="lanes")
        axes.loglog(
            adaptive["contacts"], adaptive["error_mm"], "o-", color=theme.ESTIMATE, label="adaptive"
        )
        line = np.array([adaptive["contacts"].min(), fixed["contacts"].max()])
        axes.loglog(
            line, least / np.sqrt(line), "--", color=theme.MUTED, label="no choice is below"
        )
        axes.set(xlabel="contacts", ylabel="mean error (mm)", title=f"taxels {pitch} mm apart")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.legend()
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
