"""The whole job: from a scene to a recording, a calibration, metrics, figures and a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from .core.arguments import check_seed
from .core.atomic_io import check_folder, write_json
from .core.errors import CalibrationError, GraphError, ReachError
from .core.provenance import StageTimer, provenance
from .estimation.calibrate import Estimation
from .estimation.calibration import Calibration
from .estimation.demonstration import Demonstration, demonstrate
from .estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from .estimation.uncertainty import metrics as truth
from .recording.recording import Recording
from .scene.belief import Belief
from .scene.scene import Scene
from .simulation.response import ForceResponse, force_response
from .simulation.simulate import Progress, simulate

if TYPE_CHECKING:
    from .exploration.path import Path as Way
    from .skin.skin import Skin
    from .study.sensitivity.budget import BudgetReport
    from .study.sensitivity.request import Request

METHODS = ("trilateration", "three_circles", "posegraph", "posegraph_isotropic", "posegraph_paper")
"""Methods that run on the same recording beside the joint estimate."""
RESULTS = ("calibration.parquet", "calibration.csv", "metrics.json", "report.html")
"""Files that follow from a recording."""
FLOATING = 3
"""Taxels by which a whole that floats is laid on the truth."""
MAPS = 16
"""A report takes as much processor time as this many maps of the estimates."""


@contextmanager
def _stage(name: str, progress: Progress | None) -> Iterator[None]:
    """Show a stage whose length is not known before it ends."""
    if progress is not None:
        progress(name, 0, 1)
    yield
    if progress is not None:
        progress(name, 1, 1)


@dataclass(frozen=True)
class Result:
    """What a run found."""

    scene: Scene
    recording: Recording
    calibration: Calibration
    comparisons: dict[str, Calibration]
    demonstration: Demonstration | None
    force: ForceResponse
    metrics: dict[str, Any]
    ledger: BudgetReport | None = None
    """What an error budget decided, where there was one."""


def forget(folder: Path) -> None:
    """Take out what an earlier run found: it is not of the new recording."""
    for name in RESULTS:
        (folder / name).unlink(missing_ok=True)


def run(
    name: str | Path,
    folder: str | Path,
    seed: int = 0,
    progress: Progress | None = None,
    request: Request | None = None,
    budget: float | None = None,
) -> Result:
    """Run a scene through the whole job and write everything into `folder`.

    request: an accuracy or a time; a pilot run then chooses every setting, and the metrics hold
    what it promised. budget: taxel error, m, that may be left out, in place of the scene's
    own; `ms.budget` then decides what is on. Raises MeshskinError kinds: what is wrong, the value,
    the limit, and what to do.
    """
    from .study.sensitivity.budget import budget as decide

    check_seed(seed)
    folder, clock = Path(folder), StageTimer()
    with clock.stage("load"):
        scene = Scene.load(name)
        if budget is not None:
            scene = scene.with_(budget=budget)
        check_folder(folder)
    ledger = None
    if scene.budget is not None:
        with clock.stage("budget"):
            ledger = decide(scene, seed=seed, progress=progress)
            scene = ledger.scene
    path, promise, rest = None, None, NEWTON_TOLERANCE
    if request is not None:
        with clock.stage("pilot"), _stage("pilot", progress):
            scene, path, rest, promise = _promised(scene, request, seed, clock)
    with clock.stage("simulate"):
        recording = simulate(scene, seed, path=path, out=folder / "recording", progress=progress)
    forget(folder)
    with clock.stage("calibrate"):
        belief = scene.belief() if ledger is None else ledger.belief
        tolerance = rest if ledger is None else ledger.tolerance
        estimation = Estimation(recording, belief)
        calibration = estimation.calibrate(tolerance=tolerance)
        calibration.save(folder / "calibration")
    with clock.stage("compare"):
        comparisons, missing = _compared(estimation)
        demonstration = _demonstrated(scene, recording, seed)
    with clock.stage("metrics"):
        force = _force(recording, scene)
        metrics = _assess(scene, belief, recording, calibration, force, demonstration)
        metrics |= _errors(comparisons, scene.skin) | missing
        if ledger is not None:
            metrics["budget"] = ledger.metrics()
        if promise is not None:
            metrics["promise"] = promise
    result = Result(
        scene, recording, calibration, comparisons, demonstration, force, metrics, ledger
    )
    with clock.stage("report"):
        _report(result, folder, seed, clock.seconds)
    if promise is not None:
        promise["came_to"] = {
            "error_mm": metrics["position_error_mm"]["mean"],
            "seconds": sum(clock.seconds.values()),
            "processor_seconds": clock.processor,
        }
    metrics["seconds"] = {k: round(v, 4) for k, v in clock.seconds.items()}
    write_json(folder / "metrics.json", metrics)
    return result


def _promised(
    scene: Scene, request: Request, seed: int, clock: StageTimer
) -> tuple[Scene, Way, float, dict[str, Any]]:
    """The scene at the setting that keeps a request best, its path, the tolerance of its estimate,
    and what is promised.

    Raises StudyError where nothing keeps it.
    """
    from .exploration.plan import plan_exploration
    from .study.sensitivity.pilot import pilot

    tried = pilot(scene, request, METHODS, _drawing(scene), seed, clock.start)
    reason: ReachError | None = None
    for promise in tried.choose(request):
        made = promise.setting.scene(scene, promise.setting.body(scene.body))
        try:
            path = plan_exploration(made).path
        except ReachError as error:
            reason = error
            continue
        said = {
            "asked": request.words,
            "setting": promise.setting.words(tried.base),
            "error_mm": promise.error_mm,
            "numerical_mm": promise.numerical_mm,
            "seconds": promise.seconds,
            "processor_seconds": promise.processor_seconds,
        }
        return made, path, promise.setting.tolerance, said
    assert reason is not None
    raise reason


def _compared(
    estimation: Estimation,
) -> tuple[dict[str, Calibration], dict[str, dict[str, Any]]]:
    """What the other methods find, and the metrics of those that find nothing, with the reason."""
    found: dict[str, Calibration] = {}
    missing: dict[str, dict[str, Any]] = {}
    for method in METHODS:
        try:
            other = estimation.calibrate(method)
            _check_placed(other, FLOATING if method.startswith("posegraph") else 1)
        except (CalibrationError, GraphError) as error:
            missing[method] = {"mean": None, "rms": None, "max": None, "why": str(error)}
        else:
            found[method] = other
    return found, missing


def _check_placed(found: Calibration, fewest: int) -> None:
    """Raise CalibrationError where fewer taxels are placed than can be compared with the truth."""
    placed = np.isfinite(found.positions).all(axis=1)
    if placed.sum() < fewest:
        reasons = Counter(map(str, np.asarray(found.reasons)[~placed])).most_common(1)
        why = reasons[0][0] if reasons else "there are no more taxels"
        raise CalibrationError(
            f"too few taxels to compare: {why}", value=f"{placed.sum()} placed", limit=fewest
        )


def _demonstrated(scene: Scene, recording: Recording, seed: int) -> Demonstration | None:
    """The paper's own demonstration, where taxels share contacts."""
    try:
        return demonstrate(scene.skin.poses, scene.skin.ids, recording, seed)
    except (CalibrationError, GraphError):
        return None


def _drawing(scene: Scene) -> Callable[[Calibration], float]:
    """Tells the processor seconds that a report takes on this machine, by those of one map."""
    from .report import maps, theme
    from .report.plane import tangent_plane

    def drawing(found: Calibration) -> float:
        truth = scene.skin.positions
        plane = tangent_plane(truth, scene.skin.normals)
        for _ in range(2):  # the first one loads matplotlib
            begin = process_time()
            figure = maps.estimates(
                truth, found.positions, disc_radius=scene.skin.disc_radius, plane=plane
            )
            with TemporaryDirectory() as place:
                theme.save(figure, place, "map")
        return MAPS * (process_time() - begin)

    return drawing


def _force(recording: Recording, scene: Scene) -> ForceResponse:
    """How the force of a simulated recording follows its reference."""
    motion = recording.motion
    assert motion is not None
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
    assert motion is not None
    return {
        "scene": scene.name,
        "taxels": len(calibration.ids),
        "touched": int(calibration.touched.sum()),
        "contacts": len(recording.time),
        "readings": len(recording.pressure),
        "position_error_mm": truth.summary_mm(truth.position_errors(calibration, skin)),
        "crlb_mm": truth.bound_mm(recording, belief, skin),
        "nees": float(np.nanmean(truth.nees(calibration, skin))),
        "nees_band": list(truth.nees_band(int(calibration.observed[:, :2].all(axis=1).sum()))),
        "undetermined": truth.undetermined(calibration),
        "modulus_pa": calibration.modulus,
        "modulus_sigma_pa": calibration.modulus_sigma,
        "force": _force_metrics(force),
        "demonstration_mm": None if demonstration is None else 1e3 * demonstration.mean_error,
        "steps": motion.num_rows,
        "steps_per_second": recording.metadata["steps_per_second"],
    }


def _errors(comparisons: dict[str, Calibration], skin: Skin) -> dict[str, dict[str, Any]]:
    """The position errors of what the other methods found, mm."""
    errors = {}
    for method, other in comparisons.items():
        # displacements say nothing about the pose of the whole
        gauge = method.startswith("posegraph")
        errors[method] = truth.summary_mm(truth.position_errors(other, skin, gauge=gauge))
    return errors


def _force_metrics(force: ForceResponse) -> dict[str, float]:
    return {
        "reference_n": force.reference,
        "mean_n": force.mean,
        "std_n": force.std,
        "overshoot": force.overshoot,
        "settling_s": force.settling,
        "disturbance": force.disturbance,
        "lost_contact_steps": force.lost,
    }


def _report(result: Result, folder: Path, seed: int, seconds: dict[str, float]) -> None:
    """Write the page and the figures."""
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
        budget=result.ledger,
        provenance=provenance(scene=result.scene.name, seed=seed),
    )
