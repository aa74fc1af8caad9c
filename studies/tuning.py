"""Gains by optimal control: the force of figure 4 before and after, and what time costs in error.

    python studies/tuning.py --out figures/ [--scenes sphere capsule] [--full] [--json FILE]

Each scene's manoeuvre (approach, touch, rest, slide of 20 mm) is tuned for the least time, with no
more overshoot than 0.5 % and at most half the settling time of the scene's own gains. Both are then
simulated: the settling over a rest of 0.3 s, the manoeuvre against its prediction. The trade: least
force error of the first scene within some times, its joints with friction. --full takes more times,
and tunes over the corners of E* +- 20 % and 1 % of friction too. --quasi-static: without an arm.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import meshskin as ms
from meshskin.motion.response import ForceResponse, force_response
from meshskin.report import figures, theme
from meshskin.tuning.answer import Tuned, respond
from meshskin.tuning.gains import Gains
from meshskin.tuning.manoeuvre import plan
from meshskin.tuning.tune import Demands, Scenario, scenarios, where

DEMANDS = Demands(overshoot=0.005)
REST = 0.3
"""Rest over which the settling is judged, s."""
FRICTION = Scenario(friction=0.01)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the study; return its numbers by scene, and the trade."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--scenes", nargs="+", default=["sphere", "capsule"])
    parser.add_argument("--distance", type=float, default=20.0, help="of the slide, mm")
    parser.add_argument("--points", type=int, default=None, help="times of the trade")
    parser.add_argument("--delay", type=float, default=0.0, help="age of the readings, ms")
    parser.add_argument("--quasi-static", action="store_true", help="without an arm")
    parser.add_argument("--full", action="store_true", help="more times, more scenarios")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)

    found: dict[str, Any] = {}
    for name in options.scenes:
        scene = ms.Scene.load(name)
        mode = "quasi_static" if options.quasi_static else scene.loop.mode
        scene = scene.with_(
            loop=replace(scene.loop, mode=mode, delay=options.delay * 1e-3), effects=()
        )
        found[name] = compare(scene, options.distance * 1e-3, options.full, options.out)
    points = options.points or (8 if options.full else 4)
    tuned = [row.pop("tuned") for row in found.values()]
    found["trade"] = trade(tuned[0], options.distance * 1e-3, points, options.out)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


def compare(scene: ms.Scene, distance: float, full: bool, out: Path) -> dict[str, Any]:
    """One scene before and after: its numbers, its figure."""
    over = scenarios(modulus=(0.8, 1.2), friction=(0.0, 0.01)) if full else scenarios()
    before = settling(scene, scene, distance)
    rest = 0.5 * before[2].settling
    demands = DEMANDS if not full else replace(DEMANDS, overshoot=0.1, settled=0.05)
    bounds = {} if full else {"settle": (5e-3, rest)}
    tuned = ms.tune(scene, demands=demands, over=over, distance=distance, bounds=bounds)
    after = settling(scene, scene.with_(law=tuned.law), distance)
    seen = [tuned.confirm(k) for k in range(len(tuned.trajectories))]
    own = respond(scene, tuned.manoeuvres[0])[0][-1]
    draw(scene, tuned, before, after, out)
    gains = dict(zip(Gains.__dataclass_fields__, Gains.of(tuned.tuned).values, strict=True))
    row: dict[str, Any] = {
        "settling_ms": [1e3 * r[2].settling for r in (before, after)],
        "overshoot": [r[2].overshoot for r in (before, after)],
        "time_s": [float(own), float(seen[0].time[-1])],
        "difference": max(s.difference for s in seen),
        "gains": {k: float(v) for k, v in gains.items()},
        "binding": {k: tuned.multipliers[k] for k in tuned.binding[:5]},
        "iterations": tuned.iterations,
        "solve_s": tuned.solve_seconds,
    }
    print(f"{scene.name}: settling {row['settling_ms'][0]:.0f} -> {row['settling_ms'][1]:.0f} ms, "
          f"overshoot {100 * before[2].overshoot:.2f} -> {100 * after[2].overshoot:.2f} %, "
          f"manoeuvre {own:.3f} -> {row['time_s'][1]:.3f} s")  # fmt: skip
    print("  " + ", ".join(f"{k} {v:.4g}" for k, v in gains.items()))
    print(f"  predicted and simulated force agree to {100 * row['difference']:.2f} % of it; "
          f"binding: {', '.join(row['binding'])}")  # fmt: skip
    return row | {"tuned": tuned}


def settling(
    scene: ms.Scene, lived: ms.Scene, distance: float
) -> tuple[np.ndarray, np.ndarray, ForceResponse]:
    """Time from the touch, force, and response of a scene's law over a rest of REST."""
    rested = lived.with_(exploration=replace(scene.exploration, settle=REST))
    path = manoeuvre_of(rested, distance)
    time, force = respond(rested, path)
    resting = time <= time[np.argmax(force > 0)] + REST
    response = force_response(time[resting], force[resting], lived.law.force_reference)
    return time - response.touch, force, response


def manoeuvre_of(scene: ms.Scene, distance: float) -> Any:
    """The manoeuvre that `ms.tune` makes by default."""
    return plan(scene, *where(scene, None, None), distance)


def trade(tuned: Tuned, distance: float, points: int, out: Path) -> list[dict[str, float]]:
    """Least force error within some times, from that of the fastest on."""
    scene, rows = tuned.scene, []
    over = (FRICTION,) if scene.loop.mode == "arm" else (Scenario(),)
    demands = replace(DEMANDS, overshoot=0.03)
    fastest = ms.tune(scene, demands=demands, over=over, distance=distance)
    start = Gains.of(fastest.tuned)
    for factor in np.geomspace(1.03, 3.0, points):
        within = replace(demands, time=float(factor * fastest.value))
        best = ms.tune(scene, objective="force_error", demands=within, over=over,
                       distance=distance, start=start)  # fmt: skip
        start = Gains.of(best.tuned)
        seen = best.confirm()
        rows.append({"time_s": float(seen.time[-1]), "force_error": best.value,
                     "simulated_error": seen.error})  # fmt: skip
        print(f"  {rows[-1]['time_s']:.3f} s: force error {100 * best.value:.3f} % predicted, "
              f"{100 * seen.error:.3f} % simulated")  # fmt: skip
    figure = theme.canvas(5.0, 3.6)
    axes = theme.place(figure, 0.8, 0.6, 4.0, 2.8)
    time, error = ([row[k] for row in rows] for k in ("time_s", "force_error"))
    axes.plot(time, 100 * np.array(error), marker="o")
    axes.set(xlabel="Time of the manoeuvre (s)", ylabel="RMS error of the force (%)", yscale="log")
    figures.save(figure, out, "tuning_trade")
    return rows


def draw(scene: ms.Scene, tuned: Tuned, before: Any, after: Any, out: Path) -> None:
    """Figure 4 before and after, from the touch on."""
    figure = theme.canvas(7.0, 3.2)
    axes = theme.place(figure, 0.6, 0.6, 6.2, 2.2)
    for (time, force, response), label in ((before, "own gains"), (after, "tuned")):
        shown = (time > -0.01) & (time < 0.12)
        text = f"{label}: settled after {1e3 * response.settling:.0f} ms"
        axes.plot(1e3 * time[shown], force[shown], label=text)
    axes.axhline(scene.law.force_reference, color="0.6", linewidth=0.8)
    axes.set(xlabel="Time from the touch (ms)", ylabel="Force (N)", title=scene.name)
    axes.legend(frameon=False, loc="lower right")
    figures.save(figure, out, f"fig4_tuned_{scene.name}")


if __name__ == "__main__":
    main()
