"""`meshskin run SCENE --out DIR`: simulate a scene, calibrate it, write the report."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import live
from .calibrate import response_lines, row
from .options import QUIET, RESULTS, in_options, integer, option, real, refuse
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
    option(parser, "scene SCENE", "name of a shipped scene (meshskin scenes) or a TOML file")
    option(parser, "--out DIR", RESULTS, Path, required=True)
    option(parser, "--seed SEED", "seed of all random streams (default 0)", integer(0), default=0)
    request = parser.add_mutually_exclusive_group()
    for names, words in (
        ("--accuracy-mm MM", "choose the fastest settings that reach this mean error"),
        ("--seconds S", "choose the most accurate settings that take at most this time"),
        ("--budget-mm MM", "leave out effects that move the taxels by less than this"),
    ):
        option(request, names, words, real(above=0.0))
    option(parser, "--quiet", QUIET)
    page = parser.add_argument_group("a page in the browser")
    words = "show the exploration as it is calibrated online; the results follow when the replay "
    option(page, "--live", words + "is over")
    live.add_page(page)


def command(options: argparse.Namespace) -> int:
    """Run the scene and print the summary."""
    if not options.live:
        remedy = "give --live, too, or leave it out"
        refuse(options, live.PAGE, "{} is for a page in the browser", remedy)
        return _run(options)
    what = "the replay of a live view has its own time, got --live together with {}"
    refuse(options, ("seconds",), what, "leave one of them out")
    with live.LiveView(options) as view:
        code = _run(options, view.watch)
        view.finish(f"the results are in {options.out / 'report.html'}")
    return code


def _run(options: argparse.Namespace, watch: Watch | None = None) -> int:
    """Run the scene and print the summary; watch: as of `pipeline.run`."""
    from ..core.deadline import LEAST_SECONDS, STARTED, Deadline, command_began

    began = command_began()
    if options.seconds is not None:  # before the packages, which take a third of the least time
        Deadline(options.seconds, began).check_run(LEAST_SECONDS - STARTED)
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
    from ..report.words import force_notes, modulus_words

    m, calibration, force = result.metrics, result.calibration, result.metrics["force"]
    found = sum(math.isfinite(x) for x in calibration.positions[:, 0])
    if (verdict := calibration.verdict) is not None:
        verdict = replace(verdict, untested=())  # a simulation's contacts are where it says
    lines = [
        *([in_options(str(verdict))] if verdict is not None else []),
        *filter(None, [force.get("departure"), m.get("budget", {}).get("above")]),
        f"{m['scene']}: {found} of {m['taxels']} taxels calibrated from "
        f"{calibration.readings.sum()} of {m['readings']} readings in {m['contacts']} contacts",
        *_errors(m),
        row("force", f"{force['mean_n']:.4f} N, {', '.join(force_notes(force))}"),
    ]
    if calibration.modulus is not None:
        lines.append(row("E*", modulus_words(calibration, "+-")))
    lines += response_lines(calibration)
    if "promise" in m:
        lines.append(row("promised", _promise(m["promise"])))
    lines += _left_out(m, folder, result.recording.metadata.get("unreachable", {}))
    lines.append(row("not determined", m["undetermined"]))
    if m["steps_per_second"] is not None:
        lines.append(row("closed loop", f"{m['steps_per_second']:,.0f} steps/s"))
    else:
        lines.append(row("contacts to press", folder / "contacts.csv"))
    seconds = ", ".join(f"{name} {value:.2f}" for name, value in m["seconds"].items())
    lines += [row("seconds", seconds), row("report", folder / "report.html")]
    return "\n".join(lines)


def _errors(m: dict[str, Any]) -> list[str]:
    """The position errors of the estimate and of the other methods."""
    from ..estimation.comparison import METHODS
    from ..report.data import method_name

    error, bound = m["position_error_mm"], m["crlb_mm"]
    limit = f"  (bound: mean {bound['mean']:.4g})" if bound else ""
    means = {method_name(method): m[method]["mean"] for method in METHODS}
    others = [f"{name} {x:.3g} mm" for name, x in means.items() if x is not None]
    without: dict[str, list[str]] = {}  # by the reason
    for method in METHODS:
        if m[method]["mean"] is None and method not in m["left_out"]:
            without.setdefault(m[method]["why"], []).append(method_name(method))
    lines = [
        row(
            "position error",
            f"mean {error['mean']:.4g} mm, rms {error['rms']:.4g}, max {error['max']:.4g}{limit}",
        ),
        row("other methods", "; ".join(others) or "none gave a result"),
        *(row("no result", f"{'; '.join(names)}: {why}") for why, names in without.items()),
    ]
    if m["worse_than_centroid"]:
        worse = "; ".join(map(method_name, m["worse_than_centroid"]))
        lines.append(row("baseline", f"the mean error of the centroid is below that of: {worse}"))
    return lines


def _promise(promise: dict[str, Any]) -> str:
    """What was predicted of the run, and what came of it."""
    said, came = "no prediction", promise["came_to"]
    if promise["error_mm"] is not None:
        said = f"{promise['error_mm']:.3g} mm in {promise['seconds']:.3g} s"
    return (
        f"{said} for {promise['asked']} ({promise['setting']}); came to "
        f"{came['error_mm']:.3g} mm in {came['seconds']:.3g} s"
    )


def _left_out(m: dict[str, Any], folder: Path, unreachable: dict[str, str]) -> list[str]:
    """Methods and figures that no time was left for, and taxels that were not covered."""
    missing = {"not compared": m["left_out"], "not drawn": m["figures_left_out"]}
    lines = [row(k, f"no time for {', '.join(names)}") for k, names in missing.items() if names]
    if lines:
        lines.append(row("to add them", f"meshskin report {folder}"))
    counts = "{planned} of {taxels} taxels by the plan, {reached} by the run, {given_up} given up"
    lines.append(row("covered", counts.format(taxels=m["taxels"], **m["coverage"])))
    reasons = Counter(unreachable.values()).most_common()
    return lines + [row("not covered", f"{n} taxel{'s' * (n > 1)}: {why}") for why, n in reasons]
