"""`meshskin report FOLDER`: write the report page of a run or a calibration again.

FOLDER is the one that `meshskin run` or `meshskin calibrate` wrote. The page is made from its
calibration and metrics; only the other methods that the page of a run compares are estimated again.
metrics.json names the scene, recording and body; give the options for those that were moved.
"""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import CalibrationError, ConfigError, GraphError, MeshskinError
from . import body_options
from .calibrate import HELD_OUT, row
from .options import QUIET, option, refuse
from .progress_bar import bar

if TYPE_CHECKING:
    from ..core.progress import Progress
    from ..recording.recording import Recording
    from ..scene.scene import Scene


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "results FOLDER", "folder with the results", Path)
    option(parser, "--scene SCENE", "name or file of the scene that was run")
    option(parser, "--recording RECORDING", "recorded log that was calibrated", Path)
    option(parser, "--body MESH", "mesh of the body", Path)
    body_options.add(parser)
    option(parser, "--quiet", QUIET)


def command(options: argparse.Namespace) -> int:
    """Write the page and say what of it could not be made again."""
    from ..estimation.calibration import Calibration
    from ..estimation.cross_validation import CrossValidation

    if options.body is None:
        refuse(options, body_options.NAMES, "{} is for the body", "give --body, too")
    folder = options.results
    found = Calibration.load(folder / "calibration")
    metrics = _metrics(folder)
    inputs: dict[str, Any] = metrics.get("inputs", {})
    missing: list[str] = []

    def attempt(what: str, make: Any) -> Any:
        try:
            return make()
        except MeshskinError as error:
            if getattr(options, what, None) is not None:  # what was asked for is not left out
                raise
            missing.append(f"{what}: {error}")
            return None

    scene = attempt("scene", lambda: _scene(options, inputs))
    recording = attempt("recording", lambda: _recording(options, metrics))
    own = scene is not None and options.body is None
    body = scene.body if own else attempt("body", lambda: _body(options, inputs))
    validation = None
    if "cross_validation" in metrics:
        validation = attempt("held out", lambda: CrossValidation.load(folder / HELD_OUT))
    before = {k: v for k, v in metrics.get("seconds", {}).items() if k != "report"}
    with bar(options.quiet) as progress:
        truth: dict[str, Any] = {}
        if scene is not None and "crlb_mm" in metrics:  # a run, whose true skin is the scene's
            truth = {"truth": scene.skin}
            if recording is not None:
                truth |= _compared(scene, recording, int(inputs.get("seed", 0)), progress)
                metrics["left_out"] = []  # for lack of time in the run
        found.report(
            folder / "report.html", body=body, recording=recording, metrics=metrics,
            seconds=before, validation=validation, progress=progress, **truth,
        )  # fmt: skip
    if not options.quiet:
        print(f"{folder / 'report.html'}: written again")
        for line in missing:
            print(row("left out", line))
    return 0


def _metrics(folder: Path) -> dict[str, Any]:
    """The content of metrics.json. Raises ConfigError."""
    file = folder / "metrics.json"
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file} cannot be read", value=str(error)) from error


def _scene(options: argparse.Namespace, inputs: dict[str, Any]) -> Scene | None:
    """The scene of the options, or else of the inputs; None: there was none."""
    from ..scene.scene import Scene

    name = options.scene or inputs.get("scene")
    return None if name is None else Scene.load(name)


def _recording(options: argparse.Namespace, metrics: dict[str, Any]) -> Recording:
    """The recording that was calibrated: that of the options, of the folder, or of the inputs.

    Raises ConfigError where it is another one, as that of an earlier run into the same folder.
    """
    from ..recording.recording import Recording
    from ..recording.recording_files import part_path

    inputs = metrics.get("inputs", {})
    own = options.results / "recording"
    paths = [own] if part_path(own, "contacts").exists() else []
    paths += [inputs["recording"]] if "recording" in inputs else []
    paths = paths if options.recording is None else [options.recording]
    if not paths:
        raise ConfigError("it is not known which one was calibrated", remedy="give --recording")
    for path in paths[:-1]:
        with suppress(MeshskinError):
            if _is_calibrated(recording := Recording.load(path), metrics):
                return recording
    recording = Recording.load(paths[-1])
    if not _is_calibrated(recording, metrics):
        raise ConfigError(
            f"{paths[-1]} is not the recording that was calibrated",
            value=f"{len(recording.time)} contacts, {len(recording.pressure)} readings",
            remedy="give it as --recording",
        )
    return recording


def _is_calibrated(recording: Recording, metrics: dict[str, Any]) -> bool:
    """Whether the metrics are of this recording; without its digest, whether the numbers of
    contacts are equal."""
    known = metrics.get("recording_digest")
    if known is not None:
        return bool(recording.digest == known)
    return bool(metrics.get("contacts", len(recording.time)) == len(recording.time))


def _body(options: argparse.Namespace, inputs: dict[str, Any]) -> Any:
    """The body of the options, or of the inputs."""
    given = options
    if options.body is None:
        given = argparse.Namespace(**{name: inputs.get(name) for name in body_options.NAMES})
        given.body, given.export = inputs.get("body"), ""  # a mesh's link is the frame of the map
        given.folder = [Path(f) for f in inputs.get("folder") or ()] or None
        if given.body is None:
            raise ConfigError("it is not known which one it was", remedy="give --body or --scene")
    return body_options.load(Path(given.body), given)


def _compared(
    scene: Scene, recording: Recording, seed: int, progress: Progress | None
) -> dict[str, Any]:
    """The calibrations of a run by the other methods, and its demonstration, made again."""
    from ..estimation.calibrate import Estimation
    from ..estimation.comparison import compare_methods
    from ..estimation.demonstration import demonstrate

    found = compare_methods(Estimation(recording, scene.belief()), progress).found
    made: dict[str, Any] = {"comparisons": found}
    with suppress(CalibrationError, GraphError):  # where taxels share too few contacts
        made["demonstration"] = demonstrate(scene.skin.poses, scene.skin.ids, recording, seed)
    return made
