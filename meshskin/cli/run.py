"""`meshskin run SCENE --out DIR`: simulate a scene, calibrate it, write the report."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError
from . import live
from .calibrate import certainty, response_lines
from .progress_bar import bar

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..estimation.calibration import Calibration
    from ..pipeline import Result
    from ..recording.recording import Recording
    from ..scene.scene import Scene

    Watch = Callable[[Scene, Recording, Calibration], None]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "scene", metavar="SCENE", help="name of a shipped scene (meshskin scenes) or a TOML file"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of all random streams (default 0)"
    )
    request = parser.add_mutually_exclusive_group()
    for name, metavar, words in (
        ("--accuracy-mm", "MM", "choose the fastest settings that reach this mean error"),
        ("--seconds", "S", "choose the most accurate settings that take at most this time"),
        ("--budget-mm", "MM", "leave out effects that move the taxels by less than this"),
    ):
        request.add_argument(name, type=float, metavar=metavar, help=words)
    parser.add_argument("--quiet", action="store_true", help="print no progress bar and no summary")
    page = parser.add_argument_group("a page in the browser")
    page.add_argument(
        "--live", action="store_true", help="show the exploration as it is calibrated online; the "
        "results follow when the replay is over",
    )  # fmt: skip
    live.add_page(page)


def command(options: argparse.Namespace) -> int:
    """Run the scene and print the summary."""
    if not options.live:
        return _run(options)
    if options.seconds is not None:
        raise ConfigError(
            "the replay of a live view has its own time", value="--live together with --seconds",
            remedy="leave one of them out",
        )  # fmt: skip
    with live.LiveView(options) as view:
        code = _run(options, view.watch)
        view.finish(f"the results are in {options.out / 'report.html'}")
    return code


def _run(options: argparse.Namespace, watch: Watch | None = None) -> int:
    """Run the scene and print the summary; watch: as of `pipeline.run`."""
    from ..core.deadline import LEAST_SECONDS, check_run_seconds, command_began, crowding

    began = command_began()
    if options.seconds is not None:  # before the packages, which take half of the least time
        check_run_seconds(options.seconds, LEAST_SECONDS * crowding())
    from ..pipeline import run
    from ..study.sensitivity.request import Request

    request = None
    if options.accuracy_mm is not None or options.seconds is not None:
        request = Request(options.accuracy_mm, options.seconds)
    with bar(options.quiet) as progress:
        result = run(
            options.scene,
            options.out,
            seed=options.seed,
            progress=progress,
            budget=None if options.budget_mm is None else 1e-3 * options.budget_mm,
            request=request,
            watch=watch,
            began=began,  # imports count
        )
    if not options.quiet:
        if result.budget is not None:
            print(result.budget)
        print(summary(result, options.out))
    return 0


def summary(result: Result, folder: Path) -> str:
    """The text that the command prints."""
    m, calibration = result.metrics, result.calibration
    error, bound, force = m["position_error_mm"], m["crlb_mm"], m["force"]
    found = sum(math.isfinite(x) for x in calibration.positions[:, 0])
    lighter = " and ".join(f"{one:g}" for one in force.get("lighter_references_n", ()))
    scaled = f" (contacts of {lighter} N scaled to it)" if lighter else ""
    settled = f"settled in {1e3 * force['settling_s']:.0f} ms"
    if math.isinf(force["settling_s"]):
        settled = "not settled before the contact point moved"
    lines = [
        *filter(None, [force.get("departure"), m.get("budget", {}).get("above")]),
        *([str(calibration.verdict)] if calibration.verdict is not None else []),
        f"{m['scene']}: {found} of {m['taxels']} taxels calibrated from "
        f"{m['readings']} readings in {m['contacts']} contacts",
        f"  position error     mean {error['mean']:.4g} mm, rms {error['rms']:.4g}, "
        f"max {error['max']:.4g}" + (f"  (bound: mean {bound['mean']:.4g})" if bound else ""),
        "  other methods      "
        + ", ".join(
            f"{label} " + ("none" if m[key]["mean"] is None else f"{m[key]['mean']:.3g} mm")
            for key, label in (
                ("trilateration", "trilateration"),
                ("three_circles", "three chosen circles"),
                ("eq15", "eq. 15 as printed"),
                ("posegraph", "pose graph"),
                ("posegraph_paper", "pose graph of chosen circles"),
                ("centroid", "centroid"),
            )
        ),
        *(
            [f"  worse than centroid  {', '.join(m['worse_than_centroid'])}"]
            if m["worse_than_centroid"]
            else []
        ),
        f"  force              {force['mean_n']:.4f} N for {force['reference_n']:g} N{scaled}, "
        f"{settled}, "
        f"overshoot {100 * force['overshoot']:.1f} %, then "
        + (
            "left its reference: see above"
            if "departure" in force
            else f"within {100 * force['disturbance']:.2g} %"
        ),
    ]
    if calibration.modulus is not None:
        value = f"{calibration.modulus / 1e3:.4g} kPa{certainty(calibration)}"
        lines.append(f"  E*                 {value}")
    lines += response_lines(calibration)
    if "promise" in m:
        p = m["promise"]
        came = p["came_to"]
        said = "nothing"
        if p["error_mm"] is not None:
            said = f"{p['error_mm']:.3g} mm in {p['seconds']:.3g} s"
        lines.append(
            f"  promised           {said} for {p['asked']} ({p['setting']}); came to "
            f"{came['error_mm']:.3g} mm in {came['seconds']:.3g} s"
        )
    if m["left_out"]:
        lines.append(f"  not compared       no time for {', '.join(m['left_out'])}")
    if m["figures_left_out"]:
        lines.append(f"  not drawn          no time for {', '.join(m['figures_left_out'])}")
    left_out = Counter(result.recording.metadata.get("unreachable", {}).values())
    if m["left_out"] or m["figures_left_out"]:
        lines.append(f"  to add them        meshskin report {folder}")
    lines += [
        f"  not reached        {n} taxel{'s' * (n > 1)}: {why}" for why, n in left_out.most_common()
    ]
    lines += [
        "  not determined     " + m["undetermined"],
        *(
            [f"  closed loop        {m['steps_per_second']:,.0f} steps/s"]
            if m["steps_per_second"] is not None
            else [f"  contacts to press  {folder / 'contacts.csv'}"]
        ),
        "  seconds            "
        + ", ".join(f"{name} {value:.2f}" for name, value in m["seconds"].items()),
        f"  report             {folder / 'report.html'}",
    ]
    return "\n".join(lines)
