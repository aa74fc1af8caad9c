"""The settings that a request leads to: those of the best prediction that the arm can follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...core.deadline import OVERTIME, REPORT_SECONDS, Deadline, in_time
from ...core.errors import OutOfTime, ReachError, StudyError
from ...core.progress import Progress
from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...exploration.path import Path as ExplorationPath
from ...exploration.plan import plan_exploration
from ...scene.scene import Scene
from .first_run import FirstRun, first_run
from .pilot import pilot
from .request import Pilot, Request

PUNCTUAL = 0.85
"""Part of the seconds asked for that a prediction may use: the load of the machine varies."""
WORTHWHILE = 4.0
"""Seconds that must be left after the first run, in those that it took, so that its parts are
measured and another run is made: measuring takes about twice as long as the first run."""


PREDICTED = ("error_mm", "numerical_mm", "seconds", "processor_seconds")
"""Fields of a prediction that the metrics hold."""


@dataclass(frozen=True)
class Choice:
    """The settings of a run, and what it is expected to take."""

    scene: Scene
    path: ExplorationPath
    tolerance: float
    first: FirstRun
    record: dict[str, Any]
    """The prediction, for the metrics."""
    measured: Pilot | None = None
    """None: the first run is the run."""

    def without_finer(self, why: str) -> Choice:
        """The first run in place of this one."""
        return self if self.measured is None else least(self.first, self.record["asked"], why)

    def seconds(self, method: str, readings: int | None = None) -> float:
        """Processor seconds expected of a method; of all readings of the run by default."""
        if self.measured is None:
            return 0.0
        return self.measured.estimate_seconds(method, readings or self.record["readings"])


def choose(
    scene: Scene,
    request: Request,
    methods: Sequence[str],
    seed: int,
    deadline: Deadline,
    progress: Progress | None = None,
) -> Choice:
    """The settings that meet a request best. methods: run beside the joint estimate.

    Raises StudyError if no settings reach the accuracy, or if the first run takes all the time;
    ReachError if the arm cannot follow any path.
    """
    began = deadline.spent[0]
    late = replace(deadline, seconds=OVERTIME * deadline.seconds)
    with in_time(request.words, "a first run on wide lanes"):
        first = first_run(scene, seed, late, progress)
    left = deadline.left - REPORT_SECONDS * deadline.slowdown
    needed = WORTHWHILE * (deadline.spent[0] - began)
    if left < needed:
        words = f"finer settings need about {needed:.2g} s more and "
        words += f"{max(left, 0.0):.2g} s are left"
        return least(first, request.words, words)
    try:
        measured = pilot(scene, first, request, methods, seed, deadline, progress)
        return _best(scene, measured, first, request)
    except OutOfTime:
        return least(first, request.words, "measuring what finer settings take took too long")
    except StudyError:
        if request.seconds is None:
            raise
        return least(first, request.words, "finer settings would take longer")


def least(first: FirstRun, asked: str, why: str) -> Choice:
    """The first run as the run, which nothing was predicted for."""
    setting = f"{first.words}, because {why}"
    record = {"asked": asked, "setting": setting, **dict.fromkeys(PREDICTED)}
    record["readings"] = len(first.recording.pressure)
    return Choice(first.scene, first.path, NEWTON_TOLERANCE, first, record)


def _best(scene: Scene, measured: Pilot, first: FirstRun, request: Request) -> Choice:
    """The best prediction whose path the arm can follow."""
    reason: ReachError | None = None
    punctual = request
    if request.seconds is not None:
        punctual = replace(request, seconds=PUNCTUAL * request.seconds)
    for prediction in measured.choose(punctual):
        chosen = prediction.setting.scene(scene, prediction.setting.body(scene.body))
        try:
            path = plan_exploration(chosen).path
        except ReachError as error:
            reason = error
            continue
        readings = measured.readings * measured.growth(prediction.setting)
        words = prediction.setting.words(measured.base)
        record: dict[str, Any] = {"asked": request.words, "setting": words}
        record |= {name: getattr(prediction, name) for name in PREDICTED}
        record["readings"] = round(readings)
        return Choice(chosen, path, prediction.setting.tolerance, first, record, measured)
    assert reason is not None
    raise reason
