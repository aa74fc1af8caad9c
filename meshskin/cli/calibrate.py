"""`meshskin calibrate RECORDING --out DIR`: calibrate a skin from a recorded log.

RECORDING is the folder of a run, the common prefix of the names of a recording's files, or a folder
with contacts.csv (columns time, px, py, pz, force; also qw, qx, qy, qz if the indenter's offset is
unknown; one row per frame in contact, contact points in the body frame) and readings.csv (columns
time, taxel, pressure; for raw readings, with --raw, reading or count in place of pressure). Columns
are in SI units or name their unit: px_mm, pressure_kpa, time_ms.

With --map, RECORDING is a robot's own log: with --indenter-mm its contacts follow from joint
angles, else from the streams that the map names.

Exit code 0: the verdict is PASS or DOUBT; 1: it is FAIL, the results are written and must not be
used; 2: bad input.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from . import belief_options, export_options, log_options
from .belief_options import belief_of
from .export_options import Export
from .log_options import CORRECTED, FromLog, from_log
from .options import QUIET, RESULTS, in_options, integer, option, refuse
from .progress_bar import bar

if TYPE_CHECKING:
    from ..core.progress import Progress
    from ..estimation.calibration import Calibration
    from ..recording.recording import Recording

FAILED = 1
"""Exit code where the verdict is FAIL."""
SHOWN = 8
"""Taxels with faults that the summary lists; metrics.json has all."""
HELD_OUT = "cross_validation.parquet"
"""File of the contacts that were held out, in the folder of the results."""
TOUCHES = 3
"""Touches that are advised where a calibration is not complete: the next ones follow from these."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "recording RECORDING", "recorded log, see above", Path)
    option(parser, "--out DIR", RESULTS, Path, required=True)
    belief_options.add(parser)
    log_options.add(parser)
    method = "estimator: joint (default), trilateration, three_circles, eq15, posegraph, "
    method += "posegraph_isotropic, posegraph_paper, centroid or coactivation"
    option(parser, "--method METHOD", method, default="joint")
    option(parser, "--iterations N", "iteration limit of the joint estimate", integer(1))
    option(
        parser, "--cross-validate FOLDS", "split the contacts in FOLDS folds, and locate those of "
        "each by a skin calibrated on the others", integer(2),
    )  # fmt: skip
    export_options.add(parser)
    option(parser, "--quiet", QUIET)


def command(options: argparse.Namespace) -> int:
    """Calibrate, write the results, and print the summary."""
    from ..estimation.uncertainty.verdict import FAIL

    with bar(options.quiet) as progress:
        found, words = _calibrated(options, progress)
    if not options.quiet:
        print(words)
    return FAILED if found.verdict is not None and found.verdict.level == FAIL else 0


def _calibrated(options: argparse.Namespace, progress: Progress | None) -> tuple[Calibration, str]:
    """The calibration, whose results are written once all are there, and the summary."""
    from ..core.atomic_io import check_folder, remove_results, write_json
    from ..core.provenance import provenance
    from ..estimation.calibrate import calibrate

    _check(options)
    export = Export.of(options)
    clock = perf_counter()
    loaded = recorded(options) if options.map is None else None
    check_folder(options.out)
    given = loaded or from_log(options, progress)
    recording, belief = given.recording, given.belief
    limit = {} if options.iterations is None else {"iterations": options.iterations}
    found = given.found or calibrate(
        recording, belief, method=options.method, progress=progress, **limit
    )
    validation, folds = None, options.cross_validate
    if folds is not None:
        validation = found.cross_validate(recording, folds, belief, progress)
    metrics = assess(found, recording) | {"inputs": belief_options.inputs(options)}
    remove_results(options.out)
    found.save(options.out / "calibration")
    if options.map is not None:
        recording.save(options.out / "recording")
    if given.robot is not None:
        given.robot.save(options.out / CORRECTED)
    if given.joints is not None:
        metrics["kinematics"] = given.joints.metrics()
    if validation is not None:
        metrics["cross_validation"] = validation.metrics()
        validation.save(options.out / HELD_OUT)
    found.report(
        options.out / "report.html",
        body=belief.body,
        recording=recording,
        metrics=metrics,
        seconds=found.seconds,
        provenance=provenance(recording=str(options.recording)),
        validation=validation,
        progress=progress,
    )
    metrics["seconds"] = {**found.seconds, "all": perf_counter() - clock}
    write_json(options.out / "metrics.json", metrics)
    mount = None if given.joints is None else given.joints.mount
    exported = [] if export is None else [export.write(found, mount)]
    return found, "\n".join([summary(found, metrics, options.out), *exported, *given.lines])


def _check(options: argparse.Namespace) -> None:
    """Raise ConfigError for a method that does not exist, and for options that it has not."""
    from ..core.arguments import check_name
    from ..estimation.calibrate import METHODS

    check_name("method", options.method, tuple(METHODS))
    if options.method != "joint":
        refuse(options, ("iterations",), f"{{}} is not for the method {options.method}")
    if options.indenter_mm is not None:
        refuse(options, ("iterations",), "{} is not for contacts from joint angles")


def recorded(options: argparse.Namespace) -> FromLog:
    """The recording in two tables, and the belief about it."""
    from ..recording.recording import Recording

    remedy = "give --map, too (`meshskin init LOG` writes a map), or leave it out"
    refuse(options, log_options.NAMES, "{} is for a robot's log", remedy)
    recording = Recording.load(options.recording)
    every = recording.metadata.get("taxel_ids") or np.unique(recording.reading_taxel)
    return FromLog(recording, belief_of(options, every), [])


def assess(found: Calibration, recording: Recording) -> dict[str, Any]:
    """The content of metrics.json: quantities that need no ground truth."""
    from ..estimation.uncertainty.metrics import without_truth

    good = found.observed[:, :2].all(axis=1)
    sigma = 1e3 * found.position_sigma[good]
    return without_truth(found, recording) | {
        "method": found.method,
        "determined": int(good.sum()),
        "sigma_mm": {"mean": float(sigma.mean()), "max": float(sigma.max())} if good.any() else {},
        "unknowns": {name: list(value) for name, value in found.unknowns.items()},
        "rests_on_priors": list(found.undetermined),
        "fit": None if found.fit is None else {"p": found.fit.p, "words": found.fit.words},
        "faults": faults(found),
        "next_touches": next_touches(found),
    }


def next_touches(found: Calibration) -> list[str]:
    """The touches that reduce the largest uncertainties most, in words; none where the verdict is
    PASS and every taxel is determined, or where no contact can be aimed at a taxel. A taxel whose
    reading never changes is not looked for."""
    from ..core.errors import MeshskinError
    from ..estimation.calibrate import CONSTANT
    from ..estimation.uncertainty.verdict import PASS

    dead = np.asarray(found.reasons) == CONSTANT
    done = found.verdict is not None and found.verdict.level == PASS
    if found.belief is None or (done and found.observed[~dead, :2].all()):
        return []
    try:
        planned = found.next_contacts(TOUCHES)
    except MeshskinError:
        return []
    lines = [
        f"({', '.join(f'{1e3 * x:.1f}' for x in point)}) mm, for taxel {taxel}"
        for point, taxel in zip(planned.points, planned.taxel, strict=True)
    ]
    if count := len(np.setdiff1d(planned.unreached, found.ids[dead])):
        lines.append(f"sweep for the {count} taxel{'s' * (count > 1)} without any reading")
    return lines


def faults(found: Calibration) -> dict[str, str]:
    """Faults of taxels by taxel id."""
    if found.faults is None:
        return {}
    return {str(k): f for k, f in zip(found.ids, found.faults, strict=True) if f}


def row(name: str, value: object) -> str:
    """A line of a summary."""
    return f"  {name:<16} {value}"


def response_lines(found: Calibration) -> list[str]:
    """Lines that say what was learned of the response; none where the contact model's was used."""
    if found.response is None:
        return []
    words = found.response.describe()
    return [row("response", "learned with the taxels"), *(f"    {text}" for text in words)]


def summary(found: Calibration, metrics: dict[str, Any], folder: Path) -> str:
    """The text that the command prints."""
    from ..estimation.cross_validation import held_out_in_words
    from ..report.words import modulus_words

    lines = [
        *([in_options(str(found.verdict))] if found.verdict is not None else []),
        *(f"  touch next: {words}" for words in metrics.get("next_touches", ())),
        f"{metrics['determined']} of {metrics['taxels']} taxels determined from "
        f"{metrics['readings']} readings in {metrics['contacts']} contacts",
    ]
    if metrics["sigma_mm"]:
        spread = metrics["sigma_mm"]
        lines.append(row("sigma", f"mean {spread['mean']:.4g} mm, max {spread['max']:.4g}"))
    if found.modulus is not None:
        lines.append(row("E*", modulus_words(found, "+-")))
    for name, words in found.parameter_words().items():
        if name not in ("modulus", "contact_scatter", "force_scatter"):
            lines.append(row(name, words))
    lines += response_lines(found)
    if "gain" in found.taxel_unknowns:
        gains = found.taxel_unknowns["gain"][:, 0]
        lines.append(row("gains", f"{100 * np.nanstd(gains):.2g} % apart (1 sigma)"))
    if found.fit is not None:
        lines.append(row("test of fit", found.fit.words))
    if "cross_validation" in metrics:
        lines.append(row("held out", held_out_in_words(metrics["cross_validation"])))
    lines.append(row("not determined", metrics["undetermined"]))
    lost = Counter(map(str, np.asarray(found.reasons)[~np.isfinite(found.positions).all(axis=1)]))
    lines += [row("left out", f"{n} taxel{'s' * (n > 1)}: {why}") for why, n in lost.most_common()]
    named = list(metrics["faults"].items())
    lines += [row(f"taxel {k:>6}", words) for k, words in named[:SHOWN]]
    if len(named) > SHOWN:
        lines.append(f"  and {len(named) - SHOWN} more: metrics.json")
    return "\n".join([*lines, row("report", folder / "report.html")])
