"""The pipeline of one run: scene, recording, calibration, metrics, figures and report.

Each package is entered once: the scene is loaded, simulated into a recording, calibrated under the
belief, compared with the other methods, assessed against the true skin, and reported.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .core.arguments import check_integer
from .core.atomic_io import check_folder, remove_results, write_json
from .core.deadline import (
    FIGURE_SECONDS,
    IMPORT_SECONDS,
    LEAST_SECONDS,
    PAGE_SECONDS,
    REPORT_SECONDS,
    Deadline,
    in_time,
)
from .core.errors import CalibrationError, GraphError, OutOfTime
from .core.progress import Progress, Stage
from .core.provenance import StageTimer, provenance
from .estimation.calibrate import Estimation
from .estimation.calibration import Calibration
from .estimation.comparison import METHODS, Comparison, compare_methods, worse_than_centroid
from .estimation.demonstration import Demonstration, demonstrate
from .estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from .estimation.uncertainty import metrics as truth
from .exploration.left_out import coverage
from .exploration.plan import plan_exploration
from .recording.recording import Recording
from .scene.file import read_tables
from .scene.scene import Scene
from .simulation.response import ForceResponse, controlled_force, describe_departure, force_response
from .simulation.simulate import simulate

if TYPE_CHECKING:
    from .core.beside import Beside
    from .report.figure_set import Drawn
    from .study.sensitivity.budget import BudgetReport
    from .study.sensitivity.choice import Choice
    from .study.sensitivity.first_run import FirstRun
    from .study.sensitivity.request import Request


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


def run(
    name: str | Path,
    folder: str | Path,
    seed: int = 0,
    progress: Progress | None = None,
    request: Request | None = None,
    budget: float | None = None,
    watch: Callable[[Scene, Recording, Calibration], None] | None = None,
    began: tuple[float, float] | None = None,
) -> Result:
    """Simulate, calibrate and report a scene; write all files into `folder`.

    name: shipped scene or TOML file; request: an accuracy or a time, for which a pilot run chooses
    the settings (the metrics hold its prediction). A time is a deadline: methods of comparison and
    figures that do not fit are left out and named, and where the chosen run does not fit, the
    pilot's is the result, which may take 1.15 of the time. budget: taxel error, m, that may be
    neglected, in place of the scene's own: `ms.budget` then chooses the effects. watch: called once
    the recording is calibrated; its time counts for no stage. began: wall and processor time, s, of
    an earlier begin. Raises StudyError for a time that even the pilot run does not fit in, where it
    can before that run, and other MeshskinErrors that name the value, the limit and the remedy.
    """
    check_integer("seed", seed, least=0)
    seconds = math.inf if request is None or request.seconds is None else request.seconds
    deadline = Deadline(seconds) if began is None else Deadline(seconds, began)
    timer = StageTimer({} if began is None else {"start": deadline.spent[0]})
    job = _Job(name, Path(folder), seed, deadline, progress, timer)
    plan = _planned(job, _loaded(job, budget), request)
    done, choice = _calibrated(job, plan)
    done.calibration.save(job.folder / "calibration")
    if watch is not None:
        watched = Stage(progress, "live")
        watch(done.scene, done.estimation.recording, done.calibration)
        watched.end()
    with _early_figures(job, done) as early:
        comparison, demonstration = _compared(job, done, choice)
        with job.timer.stage("metrics"):
            force = _force(done.estimation.recording, done.scene)
            metrics = _assess(done, force, demonstration) | comparison.errors(done.scene.skin)
            metrics |= _account(job, metrics, plan.budget, comparison, choice)
        result = Result(
            done.scene, done.estimation.recording, done.calibration, comparison.found,
            demonstration, force, metrics, plan.budget,
        )  # fmt: skip
        _report(job, result, early)
    if choice is not None:
        choice.record["came_to"] = _came_to(deadline, metrics)
    metrics["seconds"] = {k: round(v, 4) for k, v in job.timer.seconds.items()}
    write_json(job.folder / "metrics.json", metrics)
    return result


@dataclass(frozen=True)
class _Job:
    """What all stages of a run share."""

    name: str | Path
    """The shipped scene or TOML file."""
    folder: Path
    """Where the results go."""
    seed: int
    deadline: Deadline
    progress: Progress | None
    timer: StageTimer


@dataclass(frozen=True)
class _Planned:
    """The scene that is run, and the decisions that it follows from."""

    scene: Scene
    budget: BudgetReport | None
    choice: Choice | None
    """The settings that a request chose; None without one."""


def _loaded(job: _Job, budget: float | None) -> Scene:
    """The scene, with a budget, m, in place of its own unless None; the folder exists.

    Raises StudyError where its run takes longer than the deadline.
    """
    from .study.sensitivity.first_run import least_loading, least_seconds

    tables, folder = read_tables(job.name)
    job.deadline.check_run(LEAST_SECONDS - IMPORT_SECONDS + least_loading(tables, folder))
    with job.timer.stage("load"):
        Stage(job.progress, "plan")  # goes on, and ends, in `simulate`
        scene = Scene.from_tables(tables, folder)
        if budget is not None:
            scene = scene.with_(budget=budget)
        check_folder(job.folder)
        if math.isfinite(job.deadline.seconds) and scene.indenter.carried_by is None:
            job.deadline.check_run(least_seconds(scene) + PAGE_SECONDS)
    return scene


def _planned(job: _Job, scene: Scene, request: Request | None) -> _Planned:
    """The scene with the effects that its budget needs, and the settings that meet a request."""
    from .study.sensitivity.budget import budget
    from .study.sensitivity.choice import choose

    decided = choice = None
    if scene.budget is not None:
        with job.timer.stage("budget"):
            with in_time(f"{job.deadline.seconds:g} s", "the choice of effects for a budget"):
                decided = budget(scene, seed=job.seed, progress=job.deadline.hook(job.progress))
            scene = decided.scene
    if request is not None:
        with job.timer.stage("pilot"):
            choice = choose(scene, request, METHODS, job.seed, job.deadline, job.progress)
    return _Planned(scene, decided, choice)


@dataclass(frozen=True)
class _Calibrated:
    """A scene that was simulated and calibrated."""

    scene: Scene
    estimation: Estimation
    calibration: Calibration


def _calibrated(job: _Job, plan: _Planned) -> tuple[_Calibrated | FirstRun, Choice | None]:
    """The run of the plan, or the pilot's where that does not fit; with what was chosen."""
    choice = plan.choice
    if choice is None or choice.measured is not None:
        with suppress(OutOfTime):
            return _simulated(job, plan), choice
    assert choice is not None  # without a request there is no deadline
    choice = choice.without_finer("the chosen run did not fit")
    choice.first.recording.save(job.folder / "recording")
    remove_results(job.folder)
    return choice.first, choice


def _simulated(job: _Job, plan: _Planned) -> _Calibrated:
    """The plan's scene simulated into the folder, and calibrated.

    Raises OutOfTime where no time would be left for the report.
    """
    scene, choice, path = plan.scene, plan.choice, None
    tolerance, later = NEWTON_TOLERANCE, REPORT_SECONDS
    if choice is not None:
        scene, path, tolerance = choice.scene, choice.path, choice.tolerance
        later += choice.seconds("joint")
    with job.timer.stage("simulate"):
        if scene.indenter.carried_by is not None:
            contacts = plan_exploration(scene)
            contacts.save_contacts(job.folder / "contacts.csv")
            path = contacts.path
        hook = job.deadline.hook(job.progress, later)
        out = job.folder / "recording"
        with warnings.catch_warnings():
            # summary and report say this, after the verdict
            warnings.filterwarnings("ignore", "the contact force left")
            recording = simulate(scene, job.seed, path=path, out=out, progress=hook)
    remove_results(job.folder)
    with job.timer.stage("calibrate"):
        belief = scene.belief() if plan.budget is None else plan.budget.belief
        tolerance = tolerance if plan.budget is None else plan.budget.tolerance
        estimation = Estimation(recording, belief)
        hook = job.deadline.hook(job.progress, REPORT_SECONDS)
        calibration = estimation.calibrate(tolerance=tolerance, progress=hook)
    return _Calibrated(scene, estimation, calibration)


def _compared(
    job: _Job, done: _Calibrated | FirstRun, choice: Choice | None
) -> tuple[Comparison, Demonstration | None]:
    """The recording calibrated by the other methods, and the demonstration of the pose graph; None
    where taxels share too few contacts, or the time is used up."""
    with job.timer.stage("compare"):
        expected = (lambda _: 0.0) if choice is None else choice.seconds
        comparison = compare_methods(
            done.estimation, job.progress, job.deadline, REPORT_SECONDS, expected
        )
        with suppress(CalibrationError, GraphError, OutOfTime):
            job.deadline.check(REPORT_SECONDS)
            skin, recording = done.scene.skin, done.estimation.recording
            return comparison, demonstrate(skin.poses, skin.ids, recording, job.seed)
    return comparison, None


def _force(recording: Recording, scene: Scene) -> ForceResponse:
    """The response of the contact force in a simulated recording."""
    motion = recording.motion
    if motion is None:  # contacts that are pressed one by one
        planned = np.array(recording.metadata.get("forces_n", [scene.law.force_reference]))
        nearest = np.argmin(np.abs(recording.force[:, None] - planned), axis=1)
        return force_response(recording.time, recording.force, planned[nearest])
    return force_response(*controlled_force(motion))


def _assess(
    done: _Calibrated | FirstRun, force: ForceResponse, demonstration: Demonstration | None
) -> dict[str, Any]:
    """The metrics of the joint estimate against the truth, and of the force."""
    scene, calibration = done.scene, done.calibration
    recording, belief = done.estimation.recording, done.estimation.belief
    motion, skin = recording.motion, scene.skin
    located = np.isfinite(calibration.positions).all(axis=1)
    return truth.without_truth(calibration, recording) | {
        "scene": scene.name,
        "coverage": coverage(len(skin), recording.metadata.get("unreachable", {})),
        "readings": len(recording.pressure),
        "position_error_mm": truth.summary_mm(truth.position_errors(calibration, skin)),
        "crlb_mm": truth.bound_mm(recording, belief, skin, calibration.ids[located]),
        "nees": float(np.nanmean(truth.nees(calibration, skin))),
        "nees_band": _nees_band(calibration),
        "force": force.metrics(describe_departure(recording)),
        "demonstration_mm": None if demonstration is None else 1e3 * demonstration.mean_error,
        "steps": motion.num_rows if motion else 0,
        "steps_per_second": recording.metadata.get("steps_per_second"),
    }


def _account(
    job: _Job,
    metrics: dict[str, Any],
    budget: BudgetReport | None,
    comparison: Comparison,
    choice: Choice | None,
) -> dict[str, Any]:
    """The metrics of what was decided, predicted and left out, and of the inputs."""
    each = {"joint": metrics["position_error_mm"], **{name: metrics[name] for name in METHODS}}
    more: dict[str, Any] = {"worse_than_centroid": worse_than_centroid(each)}
    if budget is not None:
        more["budget"] = budget.metrics() | {"above": budget.explain(1e-3 * each["joint"]["mean"])}
    more["left_out"] = list(comparison.left_out)
    if choice is not None:
        more["promise"] = choice.record
    own = Path(job.name).suffix == ".toml"
    scene = str(Path(job.name).resolve() if own else job.name)
    return more | {"inputs": {"scene": scene, "seed": job.seed}}


def _early_figures(job: _Job, done: _Calibrated | FirstRun) -> Beside[Drawn]:
    """The figures that need no comparison, drawn beside it; none where the time is limited."""
    from .report.data import ReportData
    from .report.page import draw_early

    scene, recording = done.scene, done.estimation.recording
    metrics = {"force": {"reference_n": _force(recording, scene).reference}}
    data = ReportData(done.calibration, recording, scene.skin, metrics=metrics, body=scene.body)
    return draw_early(job.folder, data, forked=math.isinf(job.deadline.seconds))


def _report(job: _Job, result: Result, early: Beside[Drawn]) -> None:
    """Draw the report into the folder; the metrics say which figures no time is left for."""
    from .report.data import ReportData
    from .report.page import draw

    scene, metrics, beside = result.scene, result.metrics, math.isinf(job.deadline.seconds)
    with job.timer.stage("report"):
        data = ReportData(
            result.calibration, result.recording, scene.skin, result.comparisons,
            result.demonstration, metrics, job.timer.seconds,
            provenance(scene=scene.name, seed=job.seed), scene.body,
        )  # fmt: skip
        hook = job.deadline.hook(job.progress, FIGURE_SECONDS)
        done = early.result() if beside else {}
        _, left_out = draw(job.folder / "report.html", data, hook, early=done, beside=beside)
        metrics["figures_left_out"] = left_out


def _came_to(deadline: Deadline, metrics: dict[str, Any]) -> dict[str, Any]:
    """Error and time of the run, beside what was predicted of it."""
    seconds, processor = deadline.spent
    error = metrics["position_error_mm"]["mean"]
    return {"error_mm": error, "seconds": seconds, "processor_seconds": processor}


def _nees_band(calibration: Calibration) -> list[float] | None:
    """The 95 % band of the mean NEES; None for ideal data, whose NEES has no distribution."""
    if truth.is_ideal(calibration):
        return None
    return list(truth.nees_band(int(calibration.observed[:, :2].all(axis=1).sum())))
