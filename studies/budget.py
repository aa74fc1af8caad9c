"""Validation of the error budget: its estimates against the true errors, over scenes and seeds.

    python studies/budget.py --out figures/ [--random 2] [--budget-mm 0.2] [--first 0] [--full]

For the shipped scenes and random ones (bodies, materials, effects of random sizes), the budget
chooses; then everything on and the chosen scene are simulated and calibrated over the whole skin,
with a seed that the budget has not used. The study prints the estimated and the true error of what
was left out, how much faster the chosen scene ran (processor time of planning, simulating and
calibrating; the chosen scene is run before and after the other), and the number of taxels that are
found with everything on only; it draws one error against the other. --full: 20 random scenes.
--json FILE: each row is written as it comes, and the next run continues from it (remove the file
after a change of the code). --prices: measure instead the seconds that the budget's counts are
multiplied by, on the paper's sphere.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import isclose
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

import meshskin as ms
from meshskin import effects
from meshskin.core.atomic_io import write_json
from meshskin.core.errors import ReachError
from meshskin.estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from meshskin.exploration.path import Path as Way
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.report import precision, theme
from meshskin.scene import shipped_scenes
from meshskin.simulation.readout import effect_pipeline
from meshskin.simulation.simulate import prepare
from meshskin.study.sensitivity.knobs import SECONDS
from meshskin.study.sensitivity.replay import Replay, without_common_noise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRESH = 100
"""A seed that the budget has not seen."""
SIZES: dict[str, tuple[str, float]] = {
    "friction": ("coefficient", 1),
    "cover_fabric": ("width", 0.5),
    "crosstalk": ("coupling", 1),
    "hysteresis": ("width_relative", 1),
    "capacitive": ("half_relative", -1),
    "gain_offset": ("gain_spread", 1),
    "temperature_drift": ("gain_drift", 1),
    "gaussian_noise": ("sigma_relative", 1),
    "body_pose": ("translation", 1),
    "indenter_offset": ("offset", 1),
    "sampling": ("rate", -1),
    "encoder": ("offset_spread", 1),
    "gravity_error": ("mass", 1),
    "force_sensor": ("bias", 1),
    "relaxation": ("time_constant", 1),
}
"""The field that says how large an effect is, and the power of the factor that it goes with."""


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Run the study; return its rows by scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--random", type=int, default=2, help="number of random scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first random scene")
    parser.add_argument("--scenes", nargs="*", default=None, help="only these shipped scenes")
    parser.add_argument("--budget-mm", type=float, default=0.2)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--full", action="store_true", help="20 random scenes")
    parser.add_argument("--prices", action="store_true", help="measure the budget's prices")
    options = parser.parse_args(arguments)
    if options.prices:
        return {"prices": measure_prices()}

    shipped = shipped_scenes.scenes() if options.scenes is None else options.scenes
    count = 20 if options.full else options.random
    print(f"{'scene':22}{'estimate':>10}{'true':>10}{'ratio':>8}{'faster':>8}{'lost':>6}"
          f"{'took (s)':>10}  off")  # fmt: skip
    rows = {}
    before = stored_rows(options.json, options.budget_mm)
    for name in (*shipped, *range(options.first, options.first + count)):
        scene = ms.Scene.load(name) if isinstance(name, str) else random_scene(name)
        rows[scene.name] = before.get(scene.name) or measure_scene(scene, options.budget_mm * 1e-3)
        print(row_text(scene.name, rows[scene.name]), flush=True)
        if options.json:
            write_json(options.json, before | rows)
    ratio = np.array([r["estimate_mm"] / max(r["true_mm"], 1e-12) for r in rows.values()])
    within = np.mean((ratio > 0.5) & (ratio < 2.0))
    worst = max(r["true_mm"] for r in rows.values()) / options.budget_mm
    slowest = min(r["faster"] for r in rows.values())
    print(f"within a factor of 2: {100 * within:.0f} %; largest true error: {worst:.2f} of the "
          f"budget; least {slowest:.1f} times faster")  # fmt: skip
    theme.save(draw_errors(rows, options.budget_mm), options.out, "budget")
    return rows


def measure_prices() -> dict[str, float]:
    """Seconds of each thing that the budget counts, beside those that it reckons with."""
    scene = ms.Scene.load("sphere_noisy")
    scene = scene.with_(loop=replace(scene.loop, compile="always"))
    path = plan_exploration(scene).path
    recording = ms.simulate(scene, path=path)  # the first time pays for what is built once
    found, faces = {}, len(scene.body.mesh.faces)
    found["face"] = best_seconds(lambda: replace(scene.body).closest(scene.skin.positions)) / faces
    steps, taxels = len(path.points), len(scene.skin.ids)
    found["step"] = (
        best_seconds(lambda: [plan_exploration(scene).path, Replay.of(scene, path)]) / steps
    )
    frames = Replay.of(scene, path).frames
    for name in ("hertz", "elliptic", "layered"):
        read = effect_pipeline(scene.with_(contact=name, effects=()), 0).read
        found[name] = best_seconds(partial(read, frames, scene.skin.poses)) / len(frames) / taxels
    iterates = ms.calibrate(recording, scene.belief()).iterates
    assert iterates is not None  # a joint estimate has them
    every = len(iterates) * len(recording.pressure)
    found["reading"] = best_seconds(lambda: ms.calibrate(recording, scene.belief())) / every
    for name, value in found.items():
        print(f"{name:10}{value:10.2g} s, reckoned with {SECONDS[name]:.2g}")
    return found


def best_seconds(work: Callable[[], Any]) -> float:
    """Processor seconds, the best of three."""
    took = []
    for _ in range(3):
        begin = process_time()
        work()
        took.append(process_time() - begin)
    return min(took)


def stored_rows(file: Path | None, budget_mm: float) -> dict[str, dict[str, Any]]:
    """The rows of a run before, for the same budget."""
    if file is None or not file.exists():
        return {}
    rows = json.loads(file.read_text())
    return {name: row for name, row in rows.items() if isclose(row["budget_mm"], budget_mm)}


def random_scene(number: int) -> ms.Scene:
    """A random scene: a sphere or an ellipsoid, on an arm or without, with random effects."""
    rng = np.random.default_rng(number)
    size = rng.uniform(0.06, 0.14)
    if rng.random() < 0.5:
        body = ms.Body.sphere(size)
    else:
        body = ms.Body.ellipsoid(size * rng.uniform(0.92, 1.08, size=3))
    spacing = rng.uniform(4e-3, 6e-3)
    direction = (*rng.uniform(-0.3, 0.3, size=2), -1.0)
    count = int(rng.integers(35, 65))
    skin = ms.Skin.cover(body, spacing=spacing, count=count, region=Cap(direction=direction))
    plain = ms.Scene.load("sphere")
    scene = plain.with_(
        body=body,
        skin=skin,
        name=f"random {number}",
        contact="auto",
        indenter=replace(plain.indenter, radius=rng.uniform(8e-3, 14e-3)),
        material=ms.Material(young=rng.uniform(0.15e6, 0.4e6)),
        law=replace(plain.law, force_reference=rng.uniform(1.5, 3.5)),
        exploration=replace(plain.exploration, lane_spacing=rng.uniform(3e-3, 4.5e-3)),
        readout=ms.Readout(threshold_relative=float(rng.choice([0.0, 0.03]))),
        candidates=tuple(scaled_effect(name, rng) for name in random_effects(rng)),
    )
    floating = scene.with_(loop=replace(plain.loop, mode="quasi_static"))
    if rng.random() < 0.5:
        return floating
    try:
        prepare(scene)
    except ReachError:  # the arm cannot turn every skin over the indenter
        return floating
    return scene


def random_effects(rng: np.random.Generator) -> list[str]:
    """Noise, and six to twelve other kinds of effects."""
    there = ("gaussian_noise", "elliptic_patch")  # the latter in the contact model
    names = [e.name for e in effects.registered() if e.name not in there]
    return ["gaussian_noise", *rng.permutation(names)[: rng.integers(6, 13)].tolist()]


def scaled_effect(name: str, rng: np.random.Generator) -> effects.Effect:
    """An effect between a third and three times its default size."""
    effect: Any = effects.find(name)()
    if name not in SIZES:
        return effect
    field, power = SIZES[name]
    factor = float(np.exp(rng.uniform(-np.log(3), np.log(3)))) ** power
    value = getattr(effect, field)
    large = tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
    return replace(effect, **{field: large})


def measure_scene(scene: ms.Scene, error: float) -> dict[str, Any]:
    """What the budget estimated beside what is true."""
    begin = process_time()
    ledger = ms.budget(scene, error)
    took = process_time() - begin
    belief = ledger.belief
    everything, scene = without_common_noise(ledger.everything, ledger.scene)
    path = plan_exploration(everything).path
    chosen, fast = simulate_and_calibrate(scene, path, belief, tolerance=ledger.tolerance)
    every, slow = simulate_and_calibrate(everything, path, belief)
    again = simulate_and_calibrate(scene, path, belief, tolerance=ledger.tolerance)[1]
    true = np.linalg.norm(chosen.positions - every.positions, axis=1)
    return {
        "budget_mm": 1e3 * error,
        "estimate_mm": 1e3 * ledger.estimate,
        "true_mm": 1e3 * float(np.nanmean(true)),
        "checked_mm": 1e3 * ledger.check.shift,
        "lost": int((np.isfinite(every.positions[:, 0]) & np.isnan(chosen.positions[:, 0])).sum()),
        "faster": 2 * slow / (fast + again),
        "seconds": took,
        "off": [entry.name for entry in ledger.entries if not entry.on and entry.shift],
        "knobs": {e.name: e.setting for e in ledger.entries if e.setting not in ("on", "off")},
    }


def row_text(name: str, row: dict[str, Any]) -> str:
    """A row in print."""
    ratio = row["estimate_mm"] / row["true_mm"]
    return (
        f"{name:22}{row['estimate_mm']:10.4f}{row['true_mm']:10.4f}{ratio:8.2f}"
        f"{row['faster']:8.1f}{row['lost']:6}{row['seconds']:10.1f}  " + ", ".join(row["off"])
    )


def simulate_and_calibrate(
    scene: ms.Scene, path: Way, belief: ms.Belief, tolerance: float = NEWTON_TOLERANCE
) -> tuple[ms.Calibration, float]:
    """The calibration of a scene's recording, and its processor seconds, simulation included."""
    begin = process_time()
    fresh = scene.with_(body=replace(scene.body))  # fitting its surface counts
    plan_exploration(fresh)  # a run plans its own path, which is not what is compared here
    recording = ms.simulate(fresh, FRESH, path=path.resampled(fresh.loop.dt, fresh.body))
    found = ms.calibrate(recording, belief, tolerance=tolerance)
    return found, process_time() - begin


@theme.styled
def draw_errors(rows: dict[str, dict[str, float]], budget_mm: float) -> Figure:
    """Estimate against truth, with a factor of two to either side."""
    figure = theme.new_figure(4.6, 4.2)
    axes = figure.add_subplot()
    true = np.array([r["true_mm"] for r in rows.values()])
    estimate = np.array([r["estimate_mm"] for r in rows.values()])
    ends = np.array([0.5 * min(true.min(), estimate.min()), 2.0 * max(true.max(), budget_mm)])
    axes.loglog(ends, ends, color=theme.MUTED, lw=0.8)
    axes.fill_between(ends, ends / 2, ends * 2, color=theme.MUTED, alpha=0.15, lw=0,
                      label="a factor of 2")  # fmt: skip
    axes.axvline(budget_mm, color=theme.BOUND, lw=0.8, label="budget")
    axes.plot(true, estimate, "o", color=theme.ESTIMATE, ms=4, label="scenes")
    axes.set(xlim=ends, ylim=ends, xlabel="true error of what was left out (mm)",
             ylabel="estimate (mm)", title="What the budget promised")  # fmt: skip
    precision.decimal_ticks(axes)
    axes.legend(loc="upper left")
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
