"""Gains and speeds by optimal control: figure 4 before and after, and the cost of speed.

    python studies/tuning.py --out figures/ [--scenes sphere capsule] [--full] [--json FILE]

Each scene is tuned twice. First for the least settling time, with no more overshoot than with its
own gains: predicted by RK4, which adds no numerical damping, and simulated over a rest of 0.3 s by
the scene's own loop and by CVODES (fig4_tuned_SCENE). Second for the least time of a manoeuvre:
approach, touch, rest, slide of 20 mm. For the first scene, with joint friction, the study also
gives the trade-offs (tuning_trade): settling time against allowed overshoot, and force error
against the time of the manoeuvre. --full: more points, and the manoeuvre tuned over nine scenarios
at once, the corners of E*, curvature and friction, each of them simulated (tuning_corners).
--quasi-static: without an arm.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import meshskin as ms
from meshskin.core.atomic_io import write_json
from meshskin.report import theme
from meshskin.simulation.response import ForceResponse, force_response
from meshskin.tuning.gains import Gains
from meshskin.tuning.manoeuvre import Manoeuvre
from meshskin.tuning.result import Confirmation, TuningResult, simulate_manoeuvre
from meshskin.tuning.tune import Demands, Scenario, scenarios

REST = 0.3
"""Rest over which the settling is judged, s."""
HASTE = Demands(overshoot=0.005)
"""Of the manoeuvre in the least time."""
FRICTION = Scenario(friction=0.01)
ALLOWED = {False: (5e-3, 1.5e-2), True: (1e-4, 1e-3, 5e-3, 1e-2, 1.5e-2)}
"""Overshoots of the trade, beside none, within the band of 2 % that counts as settled; more with
--full."""
CORNERS = {"modulus": (0.8, 1.2), "curvature": (0.8, 1.25), "friction": (0.0, 0.01)}
ROUGH = Demands(overshoot=0.1, settled=0.05, force=0.1)
"""What can be asked for in all the corners at once."""

Touch = tuple[np.ndarray, np.ndarray, ForceResponse]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the study; return its numbers by scene, the trades, and the corners."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--scenes", nargs="+", default=["sphere", "capsule"])
    parser.add_argument("--distance", type=float, default=20.0, help="of the slide, mm")
    parser.add_argument("--points", type=int, default=None, help="times of the trade")
    parser.add_argument("--delay", type=float, default=0.0, help="age of the readings, ms")
    parser.add_argument("--quasi-static", action="store_true", help="without an arm")
    parser.add_argument("--full", action="store_true", help="more points, nine worlds at once")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)

    found: dict[str, Any] = {}
    distance, worlds = options.distance * 1e-3, []
    for name in options.scenes:
        scene = ms.Scene.load(name)
        mode = "quasi_static" if options.quasi_static else scene.loop.mode
        loop = replace(scene.loop, mode=mode, delay=options.delay * 1e-3)
        worlds.append(scene.with_(loop=loop, effects=()))
        found[name] = tune_settling(worlds[-1], distance, options.out)
        found[name] |= tune_manoeuvre(worlds[-1], distance)
    first = worlds[0]
    found["overshoot"] = settling_trade(first, distance, ALLOWED[options.full])
    found["trade"] = force_trade(first, distance, options.points or (8 if options.full else 4))
    draw_trades(found["overshoot"], found["trade"], options.out)
    if options.full:
        found["corners"] = tune_corners(first, distance, options.out)
    if options.json:
        write_json(options.json, found)
    return found


def tune_settling(scene: ms.Scene, distance: float, out: Path) -> dict[str, Any]:
    """The least settling time at no more overshoot, before and after: numbers and figure 4."""
    tuned = least_settling_time(scene, 0.0, distance)
    made = tuned.manoeuvres[0]
    before, after = touch(scene, made), touch(scene.with_(law=tuned.law), made, tuned)
    exact = with_integrator(scene, "cvodes")
    judged = [touch(exact, made)[2], touch(exact.with_(law=tuned.law), made, tuned)[2]]
    draw_touch(scene, before, after, out)
    responses = [before[2], after[2]]
    row: dict[str, Any] = {
        "settling_ms": [1e3 * r.settling for r in responses],
        "overshoot": [r.overshoot for r in responses],
        "cvodes_settling_ms": [1e3 * r.settling for r in judged],
        "cvodes_overshoot": [r.overshoot for r in judged],
        "law": {k: float(v) for k, v in gains_of(tuned).items() if k != "speed"},
        "holds_back": {k: tuned.multipliers[k] for k in tuned.binding[:5]},
        "law_solve_s": tuned.solve_seconds,
    }
    print(f"{scene.name}: {response_text(responses)}; by CVODES {response_text(judged)}")
    return row


def response_text(pair: list[ForceResponse]) -> str:
    """Two responses in words."""
    one, two = pair
    return (f"settling {1e3 * one.settling:.0f} -> {1e3 * two.settling:.0f} ms, overshoot "
            f"{100 * one.overshoot:.3f} -> {100 * two.overshoot:.3f} %")  # fmt: skip


def tune_manoeuvre(scene: ms.Scene, distance: float) -> dict[str, Any]:
    """The manoeuvre in the least time, beside the scene's own."""
    tuned = ms.tune(scene, demands=HASTE, distance=distance)
    seen = tuned.confirm()
    own = float(simulate_manoeuvre(scene, tuned.manoeuvres[0])[0][-1])
    row: dict[str, Any] = {
        "time_s": [own, float(seen.time[-1])],
        "difference": seen.difference,
        "gains": gains_of(tuned),
        "binding": {k: tuned.multipliers[k] for k in tuned.binding[:5]},
        "iterations": tuned.iterations,
        "solve_s": tuned.solve_seconds,
    }
    print(f"  manoeuvre {own:.3f} -> {seen.time[-1]:.3f} s; predicted and simulated force agree to "
          f"{100 * seen.difference:.2f} % of it; binding: {', '.join(row['binding'])}")  # fmt: skip
    return row


def least_settling_time(
    scene: ms.Scene, overshoot: float, distance: float, start: Gains | None = None
) -> TuningResult:
    """The least settling time at an overshoot, through RK4."""
    return ms.tune(
        with_integrator(scene, "rk4"),
        objective="settling",
        demands=Demands(overshoot=overshoot),
        distance=distance,
        start=start,
    )


def with_integrator(scene: ms.Scene, name: str) -> ms.Scene:
    """The scene's loop by another integrator."""
    return scene.with_(loop=replace(scene.loop, integrator=name))


def touch(scene: ms.Scene, manoeuvre: Manoeuvre, tuned: TuningResult | None = None) -> Touch:
    """Time from the touch, force, and response of a scene's law over a rest of REST."""
    ramp = (tuned or scene).exploration.approach_ramp
    rested = replace(scene.exploration, approach_ramp=ramp, settle=REST)
    time, force = simulate_manoeuvre(scene.with_(exploration=rested), manoeuvre)
    first = time <= time[np.argmax(force > 0)] + REST - 2 * scene.loop.dt
    response = force_response(time[first], force[first], scene.law.force_reference)
    return time - response.touch, force, response


def gains_of(tuned: TuningResult) -> dict[str, float]:
    """What was found, by name."""
    gains = Gains.of(tuned.tuned_scene)
    return {name: float(getattr(gains, name)) for name in Gains.__dataclass_fields__}


def settling_trade(scene: ms.Scene, distance: float, overshoots: tuple[float, ...]) -> list[Any]:
    """Least settling times for some overshoots; the scene's own gains come first."""
    exact = with_integrator(scene, "rk4")
    best = least_settling_time(scene, 0.0, distance)
    rows = [_row(touch(exact, best.manoeuvres[0])[2])]
    for overshoot in (0.0, *overshoots):
        tuned = (
            least_settling_time(scene, overshoot, distance, Gains.of(best.tuned_scene))
            if overshoot
            else best
        )
        if tuned.value < best.value:  # else what a tighter limit allows is the best known
            best = tuned
        rows.append(_row(touch(exact.with_(law=best.law), best.manoeuvres[0], best)[2]))
        print(f"  overshoot up to {100 * overshoot:g} %: settled after "
              f"{rows[-1]['settling_ms']:.0f} ms")  # fmt: skip
    return rows


def _row(response: ForceResponse) -> dict[str, float]:
    return {"overshoot": response.overshoot, "settling_ms": 1e3 * response.settling}


def force_trade(scene: ms.Scene, distance: float, points: int) -> list[dict[str, float]]:
    """Least force error within some times, from that of the fastest on."""
    over = (FRICTION,) if scene.loop.mode == "arm" else (Scenario(),)
    demands, rows = replace(HASTE, overshoot=0.03), []
    best = fastest = ms.tune(scene, demands=demands, over=over, distance=distance)
    for factor in np.geomspace(1.03, 3.0, points):
        time = float(factor * fastest.value)
        within = replace(demands, time=time)
        start = slowed_gains(best, time - best.trajectories[0].duration, distance)
        best = ms.tune(scene, objective="force_error", demands=within, over=over,
                       distance=distance, start=start)  # fmt: skip
        seen = best.confirm()
        rows.append({"time_s": float(seen.time[-1]), "force_error": best.value,
                     "simulated_error": seen.error})  # fmt: skip
        print(f"  {rows[-1]['time_s']:.3f} s: force error {100 * best.value:.3f} % predicted, "
              f"{100 * seen.error:.3f} % simulated")  # fmt: skip
    return rows


def slowed_gains(tuned: TuningResult, spare: float, distance: float) -> Gains:
    """The gains found, the slide slower by the time to spare: where the next search begins."""
    gains = Gains.of(tuned.tuned_scene)
    slide = distance / gains.speed + gains.ramp
    slower = 1.0 + max(spare, 0.0) / slide
    return replace(gains, speed=gains.speed / slower, ramp=gains.ramp * slower)


def tune_corners(scene: ms.Scene, distance: float, out: Path) -> list[dict[str, Any]]:
    """One set of gains for all the corners, and the simulator's word on each."""
    tuned = ms.tune(scene, demands=ROUGH, over=scenarios(**CORNERS), distance=distance)
    seen = [tuned.confirm(k) for k in range(len(tuned.trajectories))]
    rows: list[dict[str, Any]] = []
    for one, foretold in zip(seen, tuned.trajectories, strict=True):
        share = np.abs(foretold.torque) / scene.arm.effort_limit
        rows.append(
            {
                "scenario": one.scenario.name,
                "difference": one.difference,
                "largest": float(one.simulated.max() / tuned.law.force_reference - 1.0),
                "force_error": one.error,
                "torque": float(share.max(initial=0.0)),
            }
        )
        print(
            "  {scenario}: predicted to {difference:.2%}, largest force {largest:+.1%}, force "
            "error {force_error:.1%}, torque {torque:.0%} of its limit".format(**rows[-1])
        )
    draw_corners(scene, seen, tuned, out)
    return rows


@theme.styled
def draw_touch(scene: ms.Scene, before: Touch, after: Touch, out: Path) -> None:
    """Figure 4 before and after, from the touch on, with the band of the settling."""
    figure = theme.new_figure(7.0, 3.2)
    axes = theme.add_axes(figure, 0.6, 0.6, 6.2, 2.2)
    reference = scene.law.force_reference
    axes.axhspan(0.98 * reference, 1.02 * reference, color=theme.FAINT, linewidth=0)
    axes.text(119, 1.03 * reference, "reference ± 2 %", ha="right", va="bottom", color=theme.MUTED)
    lines = ((before, "the scene's own gains", theme.TRUTH), (after, "tuned", theme.ESTIMATE))
    for (time, force, response), label, colour in lines:
        shown = (time > -0.01) & (time < 0.12)
        end = 1e3 * response.settling
        text = f"{label}: settled after {end:.0f} ms, overshoot {100 * response.overshoot:.2f} %"
        axes.plot(1e3 * time[shown], force[shown], label=text, color=colour)
        axes.plot(end, np.interp(1e-3 * end, time, force), "o", color=colour)
    axes.set(xlabel="Time from the touch (ms)", ylabel="Contact force (N)", xlim=(-10, 120),
             ylim=(0, 1.18 * reference), title=f"Touch of the {scene.name}")  # fmt: skip
    axes.legend(loc="lower right")
    theme.save(figure, out, f"fig4_tuned_{scene.name}")


@theme.styled
def draw_trades(overshoot: list[Any], rows: list[dict[str, float]], out: Path) -> None:
    """What haste costs: overshoot for a quick touch, force error for a quick manoeuvre."""
    figure = theme.new_figure(8.6, 3.4)
    axes = theme.add_axes(figure, 0.7, 0.6, 3.4, 2.4)
    own, *found = overshoot
    axes.plot([100 * r["overshoot"] for r in found], [r["settling_ms"] for r in found], "o-",
              color=theme.ESTIMATE, label="tuned")  # fmt: skip
    axes.plot(100 * own["overshoot"], own["settling_ms"], "s", color=theme.TRUTH,
              label="the scene's own gains")  # fmt: skip
    most = max(100 * found[-1]["overshoot"], 0.5)
    axes.set(xlabel="Overshoot (%)", ylabel="Settling time (ms)", ylim=(0, None),
             xlim=(-0.05 * most, 1.1 * most),
             title="Touch: settling against overshoot")  # fmt: skip
    axes.legend(loc="center right")
    axes = theme.add_axes(figure, 5.0, 0.6, 3.4, 2.4)
    time = [row["time_s"] for row in rows]
    axes.plot(time, [100 * row["force_error"] for row in rows], "-", color=theme.ESTIMATE,
              label="predicted")  # fmt: skip
    axes.plot(time, [100 * row["simulated_error"] for row in rows], "o", color=theme.WARNING,
              markerfacecolor="none", label="simulated")  # fmt: skip
    axes.set(
        xlabel="Time from standoff to the slide's end (s)",
        yscale="log",
        ylabel="Force error in the slide, RMS (%)",
        title="Slide: force error against time",
    )
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(loc="upper right")
    theme.save(figure, out, "tuning_trade")


@theme.styled
def draw_corners(scene: ms.Scene, seen: list[Confirmation], tuned: TuningResult, out: Path) -> None:
    """The force in every corner with one set of gains, simulated and predicted."""
    figure = theme.new_figure(7.0, 3.4)
    axes = theme.add_axes(figure, 0.6, 0.6, 4.1, 2.4)
    target, part = scene.law.force_reference, ROUGH.force
    axes.axhspan((1 - part) * target, (1 + part) * target, color=theme.FAINT, linewidth=0)
    shades = [theme.INK, *theme.PALETTE[:4]]
    for k, one in enumerate(seen):
        plain = replace(one.scenario, friction=0.0)
        names = list(dict.fromkeys(replace(s.scenario, friction=0.0).name for s in seen))
        colour = shades[names.index(plain.name)]
        dashed = bool(one.scenario.friction)
        time = 1e3 * (one.time - one.time[np.argmax(one.simulated > 0)])
        axes.plot(time, one.simulated, "--" if dashed else "-", color=colour, linewidth=1.0,
                  label=None if dashed else plain.name)  # fmt: skip
        axes.plot(time[::8], one.predicted[::8], ".", color=colour, markersize=3)
        if k == 0:
            axes.axvline(1e3 * tuned.exploration.settle, color=theme.MUTED, linewidth=0.6)
    axes.plot([], [], "--", color=theme.MUTED, label="with 1 % friction")
    axes.plot([], [], ".", color=theme.MUTED, label="predicted")
    axes.set(xlabel="Time from the touch (ms); the slide begins at the line",
             ylabel="Contact force (N)", xlim=(-10, None), ylim=(0, None),
             title=f"One set of gains in nine worlds ({scene.name})")  # fmt: skip
    axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
    theme.save(figure, out, "tuning_corners")


if __name__ == "__main__":
    main()
