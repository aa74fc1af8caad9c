"""A study: a scene, a grid of changes, seeds; every combination is a case."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...core.arguments import real, whole
from ...core.errors import ConfigError, StudyError
from ...core.provenance import check_seed, versions
from . import base as bases
from . import table as tabling
from .case import Case, Grid, Run, check, expand, lists, runner_identity
from .outcome import Limits, Outcome
from .reference import SCRIPT, Reference
from .store import Store
from .worker import Setup, Task

if TYPE_CHECKING:
    import pyarrow as pa

    from ...scene.scene import Scene


@dataclass(frozen=True)
class Progress:
    """How far a sweep is."""

    total: int
    """Cases of the study."""
    kept: int
    """Of them, those that an earlier run had settled."""
    done: int
    """Settled so far, those included."""
    failed: int
    """Of these, those that failed."""


class Executor(Protocol):
    """What runs tasks: processes of this machine, or a cluster."""

    def outcomes(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """The outcome of every task, in any order."""


@dataclass(frozen=True)
class Study:
    """Cases over a grid of parameters and seeds.

        study = ms.Study(
            "noise",
            base="sphere",
            grid={"effects.gaussian_noise.sigma_relative": [0.005, 0.01, 0.02]},
            seeds=5,
        )
        table = study.sweep("out/noise")

    Raises ConfigError for a grid that does not fit the scene, when its cases are made.
    """

    name: str
    base: str | Path | Scene | None = None
    """A scene's name, its TOML file, or a Scene made in Python (whose body, skin and arm stay as
    they are); None: no scene, the parameters are the run function's own."""
    grid: Grid | Sequence[Grid] = field(default_factory=dict)
    """Lists of values by dotted key of the scene's TOML, such as "material.young_kpa";
    "belief.KEY" changes only what the owner believes, "run.KEY" is for the run function, "method"
    names the estimator. Several grids are run one after the other."""
    seeds: int | Sequence[int] = 1
    """Seeds of each combination, or how many (from 0)."""
    method: str = "joint"
    """Estimator, where the grid has none."""
    run: Run | None = None
    """What computes a case: a function, at the top of a module, from a Case to values by name. It
    must depend on nothing but the case. None: simulate, calibrate, assess (evaluate.py)."""
    version: str = ""
    """Part of what identifies a case: change it when something that `run` calls has changed (its
    own source text is part already)."""
    time_limit: float | None = None
    """Wall time of a case, s."""
    memory_limit: float | None = None
    """Data of a worker process, bytes (Linux)."""

    def __post_init__(self) -> None:
        for name in ("time_limit", "memory_limit"):
            value = getattr(self, name)
            if value is not None:
                real(name, value, above=0.0)
        if self.memory_limit is not None and sys.platform != "linux":
            raise ConfigError("a memory limit works on Linux only", remedy="leave it out")
        for seed in self._seeds:
            check_seed(seed)

    @classmethod
    def load(cls, path: str | Path) -> Study:
        """A study from a TOML file. Raises ConfigError."""
        from .study_file import load

        return load(Path(path))

    @property
    def limits(self) -> Limits:
        """What a case may use."""
        return Limits(self.time_limit, self.memory_limit)

    @property
    def _seeds(self) -> Sequence[int]:
        if isinstance(self.seeds, int):
            return range(self.seeds)
        if isinstance(self.seeds, str) or not isinstance(self.seeds, Iterable):
            raise ConfigError(
                "seeds are whole numbers, or how many",
                value=repr(self.seeds),
                remedy="give 5 or [1, 7]",
            )
        return [s.item() if isinstance(s, np.integer) else s for s in self.seeds]

    @cached_property
    def _run(self) -> Run:
        if self.run is not None:
            return self.run
        from .evaluate import evaluate

        return evaluate

    @cached_property
    def _base(self) -> bases.Base:
        return bases.find(self.base)

    def cases(self) -> list[Case]:
        """All cases, in order. Raises ConfigError for a grid that does not fit the scene."""
        check(self._base, self.grid, self.method)
        runner = runner_identity(self._run, self.version)
        found = list(expand(self._base, self.grid, self._seeds, self.method, runner))
        if not found:
            raise ConfigError(f"the study {self.name} has no cases", remedy="give it seeds")
        if self.run is None and isinstance(self._base, bases.Nothing):
            raise ConfigError(f"the study {self.name} has no scene", remedy="give it a base")
        return found

    def table(self, out: str | Path) -> pa.Table:
        """The table as the results in the folder `out` are now, one row a case."""
        store = Store(out)
        return tabling.tables((case, store.read(case.key)) for case in self.cases())[0]

    def sweep(
        self,
        out: str | Path,
        *,
        workers: int | None = None,
        scheduler: str | None = None,
        retry: bool = False,
        progress: Callable[[Progress], None] | None = None,
    ) -> pa.Table:
        """Run what the folder `out` does not hold yet, write the tables there, and return the
        first: one row a case, with its parameters, status and results.

        workers: processes on this machine (default: one a core); the results do not depend on it.
        scheduler: address of a Dask cluster to run on instead. retry: run failed cases again.
        progress: called after each case.
        Raises ConfigError, StudyError (another run works in `out`, workers cannot start, the
        scheduler is gone), OutputError (a full disk); what is done by then is kept.
        """
        if _in_a_worker():
            raise StudyError(
                "a worker imports this script, which starts the study again",
                remedy='put what starts it under if __name__ == "__main__":',
            )
        if workers is not None:
            whole("workers", workers, least=1)
        setup = Setup(Reference.to(self._run), self._base, self.limits)
        cases, store = self.cases(), Store(out)
        with store.lock():
            store.describe(self._manifest(len(cases)))
            open_cases, failed = self._open(cases, store, retry)
            size = min(workers or cores(), max(len(open_cases), 1))
            kept = len(cases) - len(open_cases)
            state = Progress(len(cases), kept, kept, failed)
            if progress is not None:
                progress(state)
            with self._hands(setup, size, scheduler) as hands:
                for outcome in hands.outcomes(Task.of(case) for case in open_cases):
                    store.write(outcome)
                    state = Progress(
                        state.total, kept, state.done + 1, state.failed + bool(outcome.reason)
                    )
                    if progress is not None:
                        progress(state)
            table, times = tabling.tables((case, store.read(case.key)) for case in cases)
            tabling.write(table, store.folder / "table.parquet")
            tabling.write(times, store.folder / "times.parquet")
        return table

    def _open(self, cases: list[Case], store: Store, retry: bool) -> tuple[list[Case], int]:
        """The cases that are still to run, and how many of the others have failed."""
        present, failed, out = store.keys(), 0, []
        for case in cases:
            outcome = store.read(case.key) if case.key in present else None
            if outcome is None or (retry and outcome.reason) or not outcome.settled(self.limits):
                out.append(case)
            else:
                failed += outcome.reason is not None
        return out, failed

    def _hands(
        self, setup: Setup, size: int, scheduler: str | None
    ) -> AbstractContextManager[Executor]:
        if scheduler is not None:
            from .cluster import Cluster

            return Cluster(setup, scheduler)
        from .pool import Crew

        return Crew(setup, size)

    def _manifest(self, count: int) -> dict[str, Any]:
        """What the study is, for people; nothing is read back from it."""
        tables = getattr(self._base, "tables", {})
        return {
            "name": self.name,
            "cases": count,
            "base": str(self.base) if isinstance(self.base, str | Path) else tables.get("name"),
            "grid": lists(self.grid),
            "seeds": list(self._seeds),
            "method": self.method,
            "run": f"{self._run.__module__}:{self._run.__qualname__}",
            "version": self.version,
            "time_limit_s": self.time_limit,
            "memory_limit_bytes": self.memory_limit,
            "versions": versions(),
        }


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _in_a_worker() -> bool:
    """Whether a worker is just importing the script that starts the study."""
    frame: Any = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == SCRIPT:
            return True
        frame = frame.f_back
    return False
