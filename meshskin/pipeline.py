"""The pipeline of one run: scene, recording, calibration, metrics, figures and report.

Each package is entered once: the scene is loaded, simulated into a recording, calibrated under the
belief, compared with the other methods, assessed against the true skin, and reported.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from .core.arguments import check_integer
from .core.atomic_io import check_folder, write_json
from .core.errors import CalibrationError, GraphError, ReachError
from .core.progress import Progress, Stage
from .core.provenance import StageTimer, provenance
from .estimation.calibrate import Estimation
from .estimation.calibration import Calibration
from .estimation.comparison import METHODS, Comparison, compare_methods
from .estimation.demonstration import Demonstration, demonstrate
from .estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from .estimation.uncertainty import metrics as truth
from .recording.recording import Recording
from .scene.belief import Belief
from .scene.scene import Scene
from .simulation.response import ForceResponse, describe_departure, force_response
from .simulation.simulate import simulate

if TYPE_CHECKING:
    from .exploration.path import Path as ExplorationPath
    from .skin.skin import Skin
    from .study.sensitivity.budget import BudgetReport
    from .study.sensitivity.request import Request

RESULTS = (
    "calibration.parquet", "calibration.csv", "metrics.json", "report.html", "corrected.urdf",
)  # fmt: skip
"""Files that a calibration writes; those of an earlier recording are removed."""
MAPS = 16
"""Processor time of a report in units of the time of one map of the estimates (measured on the
shipped scenes; it predicts the time of a request)."""


@dataclass(frozen=True)
class Result:
    """Inputs and results of a run."""

    scene: Scene
    recording: Recording
    calibration: Calibration
    comparisons: dict[str, Calibration]
    demonstration: Demonstration | None
    force: ForceResponse
    metrics: dict[str, Any]
    budget: BudgetReport | None = None
    """The decisions of the error budget; None: the scene has no budget."""


def remove_results(folder: Path) -> None:
    """Remove the result files of an earlier recording."""
    for name in RESULTS:
        (folder / name).unlink(missing_ok=True)


def run(
    name: str | Path,
    folder: str | Path,
    seed: int = 0,
    progress: Progress | None = None,
    request: Request | None = None,
    budget: float | None = None,
    watch: Callable[[Scene, Recording, Calibration], None] | None = None,
) -> Result:
    """Simulate, calibrate and report a scene; write all files into `folder`.

    name: shipped scene or TOML file; request: an accuracy or a time, for which a pilot run chooses
    the settings (the metrics hold its prediction); budget: taxel error, m, that may be neglected,
    in place of the scene's own: `ms.budget` then chooses the effects; watch: called once the
    recording is calibrated; its time counts for no stage. Raises a MeshskinError that names the
    value, the limit and the remedy.
    """
    from .exploration.plan import plan_exploration
    from .study.sensitivity.budget import budget as apply_budget

    check_integer("seed", seed, least=0)
    folder, timer = Path(folder), StageTimer()
    with timer.stage("load"):
        Stage(progress, "plan")  # goes on, and ends, in `simulate`
        scene = Scene.load(name)
        if budget is not None:
            scene = scene.with_(budget=budget)
        check_folder(folder)
    decided = None
    if scene.budget is not None:
        with timer.stage("budget"):
            decided = apply_budget(scene, seed=seed, progress=progress)
            scene = decided.scene
    path, prediction, tolerance = None, None, NEWTON_TOLERANCE
    if request is not None:
        with timer.stage("pilot"):
            pilots = Stage(progress, "pilot", 1)
            scene, path, tolerance, prediction = _settings_for(scene, request, seed, timer)
            pilots.end()
    with timer.stage("simulate"):
        if scene.indenter.carried_by is not None:
            plan = plan_exploration(scene)
            plan.save_contacts(folder / "contacts.csv")
            path = plan.path
        recording = simulate(scene, seed, path=path, out=folder / "recording", progress=progress)
    remove_results(folder)
    with timer.stage("calibrate"):
        belief = scene.belief() if decided is None else decided.belief
        tolerance = tolerance if decided is None else decided.tolerance
        estimation = Estimation(recording, belief)
        calibration = estimation.calibrate(tolerance=tolerance, progress=progress)
        calibration.save(folder / "calibration")
    if watch is not None:
        watched = Stage(progress, "live")
        watch(scene, recording, calibration)
        watched.end()
    with timer.stage("compare"):
        comparison = compare_methods(estimation, progress)
        demonstration = None
        with suppress(CalibrationError, GraphError):  # where taxels share too few contacts
            demonstration = demonstrate(scene.skin.poses, scene.skin.ids, recording, seed)
    with timer.stage("metrics"):
        force = _force(recording, scene)
        metrics = _assess(scene, belief, recording, calibration, force, demonstration)
        metrics |= _errors(comparison, scene.skin)
        metrics["worse_than_centroid"] = _worse_than_centroid(metrics)
        if decided is not None:
            mean = metrics["position_error_mm"]["mean"]
            metrics["budget"] = decided.metrics() | {"above": decided.explain(1e-3 * mean)}
        if prediction is not None:
            metrics["promise"] = prediction
        own = Path(name).suffix == ".toml"
        metrics["inputs"] = {"scene": str(Path(name).resolve() if own else name), "seed": seed}
    result = Result(
        scene, recording, calibration, comparison.found, demonstration, force, metrics, decided
    )
    with timer.stage("report"):
        _write_report(result, folder, seed, timer.seconds, progress)
    if prediction is not None:
        prediction["came_to"] = {
            "error_mm": metrics["position_error_mm"]["mean"],
            "seconds": sum(timer.seconds.values()),
            "processor_seconds": timer.processor,
        }
    metrics["seconds"] = {k: round(v, 4) for k, v in timer.seconds.items()}
    write_json(folder / "metrics.json", metrics)
    return result


def _settings_for(
    scene: Scene, request: Request, seed: int, timer: StageTimer
) -> tuple[Scene, ExplorationPath, float, dict[str, Any]]:
    """The scene with the settings that meet a request best, its path, tolerance and prediction.

    Raises StudyError if no settings meet it, ReachError if the arm cannot follow their paths.
    """
    from .exploration.plan import plan_exploration
    from .study.sensitivity.pilot import pilot

    tried = pilot(scene, request, METHODS, _report_time(scene), seed, timer.start)
    reason: ReachError | None = None
    for prediction in tried.choose(request):
        chosen = prediction.setting.scene(scene, prediction.setting.body(scene.body))
        try:
            path = plan_exploration(chosen).path
        except ReachError as error:
            reason = error
            continue
        record = {
            "asked": request.words,
            "setting": prediction.setting.words(tried.base),
            "error_mm": prediction.error_mm,
            "numerical_mm": prediction.numerical_mm,
            "seconds": prediction.seconds,
            "processor_seconds": prediction.processor_seconds,
        }
        return chosen, path, prediction.setting.tolerance, record
    assert reason is not None
    raise reason


def _report_time(scene: Scene) -> Callable[[Calibration], float]:
    """A function that predicts the processor seconds of a report from those of one map."""
    from .report import maps, theme
    from .report.data import ReportData

    def drawing(found: Calibration) -> float:
        for _ in range(2):  # the first one loads matplotlib
            begin = process_time()
            with TemporaryDirectory() as place:
                theme.save(maps.estimates(ReportData(found, truth=scene.skin)), place, "map")
        return MAPS * (process_time() - begin)

    return drawing


def _force(recording: Recording, scene: Scene) -> ForceResponse:
    """The response of the contact force in a simulated recording."""
    motion = recording.motion
    if motion is None:  # contacts that are pressed one by one
        return force_response(recording.time, recording.force, scene.law.force_reference)
    return force_response(
        np.asarray(motion.column("time")),
        np.asarray(motion.column("force")),
        scene.law.force_reference,
        motion.column("phase").to_pylist(),
    )


def _assess(
    scene: Scene,
    belief: Belief,
    recording: Recording,
    calibration: Calibration,
    force: ForceResponse,
    demonstration: Demonstration | None,
) -> dict[str, Any]:
    """The metrics of the joint estimate against the truth, and of the force."""
    motion, skin = recording.motion, scene.skin
    return {
        "verdict": None if calibration.verdict is None else calibration.verdict.metrics(),
        "scene": scene.name,
        "taxels": len(calibration.ids),
        "touched": int(calibration.touched.sum()),
        "contacts": len(recording.time),
        "readings": len(recording.pressure),
        "position_error_mm": truth.summary_mm(truth.position_errors(calibration, skin)),
        "crlb_mm": truth.bound_mm(recording, belief, skin),
        "nees": float(np.nanmean(truth.nees(calibration, skin))),
        "nees_band": _nees_band(calibration),
        "undetermined": truth.undetermined(calibration),
        "modulus_pa": calibration.modulus,
        "modulus_sigma_pa": calibration.modulus_sigma,
        "response": None if calibration.response is None else calibration.response.metrics(),
        "force": _force_metrics(force, describe_departure(motion) if motion else ""),
        "demonstration_mm": None if demonstration is None else 1e3 * demonstration.mean_error,
        "steps": motion.num_rows if motion else 0,
        "steps_per_second": recording.metadata.get("steps_per_second"),
    }


def _nees_band(calibration: Calibration) -> list[float] | None:
    """The 95 % band of the mean NEES; None for ideal data, whose NEES has no distribution."""
    if truth.is_ideal(calibration):
        return None
    return list(truth.nees_band(int(calibration.observed[:, :2].all(axis=1).sum())))


def _errors(comparison: Comparison, skin: Skin) -> dict[str, dict[str, Any]]:
    """Position errors, mm, of the other methods, or why there are none."""
    errors: dict[str, dict[str, Any]] = {
        method: {"mean": None, "rms": None, "max": None, "why": why}
        for method, why in comparison.missing.items()
    }
    for method, other in comparison.found.items():
        # displacements say nothing about the pose of the whole
        gauge = method.startswith("posegraph")
        errors[method] = truth.summary_mm(truth.position_errors(other, skin, gauge=gauge))
    return errors


def _worse_than_centroid(metrics: dict[str, Any]) -> list[str]:
    """Methods whose mean error is above that of the baseline, the centroid of contact points."""
    baseline = metrics["centroid"]["mean"]
    errors = {"joint": metrics["position_error_mm"]["mean"]}
    errors |= {method: metrics[method]["mean"] for method in METHODS}
    known = {name: error for name, error in errors.items() if error is not None}
    return [name for name, error in known.items() if baseline is not None and error > baseline]


def _force_metrics(force: ForceResponse, departure: str) -> dict[str, Any]:
    first = {"departure": departure} if departure else {}
    return first | {
        "reference_n": force.reference,
        "mean_n": force.mean,
        "std_n": force.std,
        "overshoot": force.overshoot,
        "settling_s": force.settling,
        "disturbance": force.disturbance,
        "lost_contact_steps": force.lost,
    }


def _write_report(
    result: Result,
    folder: Path,
    seed: int,
    seconds: dict[str, float],
    progress: Progress | None,
) -> None:
    """Write the report page and the figures."""
    from .report.page import report

    report(
        folder / "report.html",
        body=result.scene.body,
        calibration=result.calibration,
        recording=result.recording,
        truth=result.scene.skin,
        comparisons=result.comparisons,
        demonstration=result.demonstration,
        metrics=result.metrics,
        seconds=seconds,
        budget=result.budget,
        provenance=provenance(scene=result.scene.name, seed=seed),
        progress=progress,
    )
