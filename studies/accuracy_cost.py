"""The cost of accuracy in time, scene by scene.

    python studies/accuracy_cost.py --out figures/ [--scenes sphere_noisy ...] [--full]

Changes the knobs of each scene (step, lanes, frame rate, estimator; with --full all of them, 3
seeds, and a finer reference), prints the cheapest setting for 1, 0.3, 0.1, 0.03 and 0.01 mm and the
second routes to the reference, and draws the work-precision fronts of all scenes. Then it requests
runs of an accuracy and of a time, and prints predicted and actual values. Seconds are processor
time, which other work on the machine changes, too. Measurements are written to the folder, scene by
scene and request by request; --resume continues from them (after a change of the code, measure
anew).
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict, TypeVar

import meshskin as ms
from meshskin import pipeline
from meshskin.cli.cost import summary
from meshskin.core.atomic_io import atomic, write_json
from meshskin.core.errors import StudyError
from meshskin.report import precision, theme
from meshskin.scene import shipped_scenes
from meshskin.study.sensitivity.cost import KNOBS, TARGETS, Costs
from meshskin.study.sensitivity.request import Request

T = TypeVar("T")
FEW = ("dt", "lanes", "rate", "method")
"""Knobs of the default size."""
ASKED = (
    *(Request(accuracy_mm=mm) for mm in (0.1, 0.03, 0.01)),
    *(Request(seconds=s) for s in (5.0, 20.0)),
)


class CostOptions(TypedDict):
    """How the costs of a scene are measured: arguments of `ms.cost`."""

    knobs: list[str]
    seeds: int
    finer: int


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the study; return its numbers by scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--scenes", nargs="*", default=None)
    parser.add_argument("--knobs", nargs="*", default=None)
    parser.add_argument("--asked", nargs="*", default=("sphere_noisy",), help="scenes of requests")
    parser.add_argument("--full", action="store_true", help="all knobs, 3 seeds, finer reference")
    parser.add_argument("--resume", action="store_true", help="keep what a run before measured")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    scenes = options.scenes or list(shipped_scenes.scenes())
    knobs = options.knobs or (KNOBS if options.full else FEW)

    found: dict[str, Costs] = {}
    cost_options: CostOptions = {
        "knobs": list(knobs),
        "seeds": 3 if options.full else 1,
        "finer": 8 if options.full else 4,
    }
    for name in scenes:

        def measured(name: str = name) -> Costs:
            return ms.cost(ms.Scene.load(name), **cost_options)

        file = options.out / f"accuracy_cost_{name}.pickle"
        costs = stored_or_measured(file, cost_options, options.resume, measured)
        print(summary(costs), flush=True)
        found[name] = costs
    theme.save(draw_fronts(found), options.out, "accuracy_cost")
    for name, costs in found.items():
        theme.save(precision.work_precision(costs, TARGETS), options.out, f"accuracy_cost_{name}")
    numbers: dict[str, Any] = {name: scene_numbers(costs) for name, costs in found.items()}
    asked = scenes if options.full else options.asked
    numbers["requests"] = []
    for name, request in product(asked, ASKED):
        file = options.out / f"request_{name}_{request.words.replace(' ', '_')}.pickle"

        def run(name: str = name, request: Request = request) -> dict[str, Any]:
            return run_request(name, request)

        numbers["requests"].append(stored_or_measured(file, {}, options.resume, run))
    if asked:
        print_requests(numbers["requests"])
    if options.json:
        write_json(options.json, numbers)
    return numbers


def stored_or_measured(
    file: Path, asked: Mapping[str, object], resume: bool, measure: Callable[[], T]
) -> T:
    """The result of `measure`, stored in a file; or that of an earlier run with these options."""
    if resume and file.exists():
        before = pickle.loads(file.read_bytes())
        if before["how"] == asked:
            return before["found"]
    found = measure()
    with atomic(file) as temporary:
        temporary.write_bytes(pickle.dumps({"how": asked, "found": found}))
    return found


def scene_numbers(costs: Costs) -> dict[str, Any]:
    """The numbers of one scene."""
    own = costs.rows[0]
    best = {f"{t:g}": costs.cheapest(t) for t in TARGETS}
    return {
        "error_mm": own.error_mm,
        "bound_mm": own.bound_mm,
        "numerical_mm": own.numerical_mm,
        "seconds": own.time,
        "cheapest_seconds": {t: None if r is None else r.time for t, r in best.items()},
        "routes_mm": {route.name: route.mean_mm for route in costs.routes},
        "settings": len(costs.rows),
    }


def run_request(name: str, request: Request, seed: int = 1) -> dict[str, Any]:
    """What a run promised, and came to over it; or why it refused."""
    try:
        with TemporaryDirectory() as place:
            promise = pipeline.run(name, place, seed=seed, request=request).metrics["promise"]
    except StudyError as error:
        return {"scene": name, "asked": request.words, "refused": str(error)}
    came = promise["came_to"]
    return {
        "scene": name,
        **promise,
        "error_ratio": came["error_mm"] / promise["error_mm"] if promise["error_mm"] else None,
        "seconds_ratio": came["seconds"] / promise["seconds"],
        "processor_ratio": came["processor_seconds"] / promise["processor_seconds"],
    }


def print_requests(requests: Sequence[dict[str, Any]]) -> None:
    """Print promises beside outcomes."""
    print(f"  {'scene':14}{'asked':>9}{'promised mm':>13}{'came to':>10}{'promised s':>12}"
          f"{'came to':>9}{'processor s':>13}{'came to':>9}  setting")  # fmt: skip
    for r in requests:
        if "refused" in r:
            print(f"  {r['scene']:14}{r['asked']:>9}  {r['refused']}")
            continue
        came = r["came_to"]
        print(f"  {r['scene']:14}{r['asked']:>9}{r['error_mm']:13.4g}{came['error_mm']:10.4g}"
              f"{r['seconds']:12.2f}{came['seconds']:9.2f}{r['processor_seconds']:13.2f}"
              f"{came['processor_seconds']:9.2f}  {r['setting']}")  # fmt: skip


@theme.styled
def draw_fronts(found: dict[str, Costs]) -> Any:
    """Error and numerical part together against seconds: every setting, and each scene's front."""
    figure = theme.new_figure(7.6, 4.6)
    axes = theme.add_axes(figure, 0.85, 0.65, 6.5, 3.5)
    for k, (name, costs) in enumerate(found.items()):
        colour = precision.COLOURS[k % len(precision.COLOURS)]
        x, y = ([getattr(r, key) for r in costs.whole] for key in ("time", "total_mm"))
        axes.plot(x, y, ".", color=colour, ms=4, alpha=0.4)
        x, y = ([getattr(r, key) for r in costs.front] for key in ("time", "total_mm"))
        axes.step(x, y, where="post", color=colour, lw=1.6, label=name.replace("_", " "))
        own = costs.rows[0]
        axes.plot(own.time, own.total_mm, "*", color=colour, ms=11, mec="white", mew=0.6)
    for target in TARGETS:
        axes.axhline(target, color=theme.FAINT, lw=0.7, zorder=0)
    axes.set(xscale="log", yscale="log", xlabel="processor time: load, simulate, calibrate (s)")
    axes.set(ylabel="error and numerical part (mm)", title="Stars: the scenes as they are")
    axes.legend(loc="upper right")
    precision.decimal_ticks(axes)
    return figure


if __name__ == "__main__":
    main()
