"""A study: a scene, a grid of changes and seeds; every combination is a case."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_integer, check_path, check_real
from ...core.config import from_table, quantity, read_toml
from ...core.errors import ConfigError, StudyError
from .base_scene import BaseScene, base_scene
from .case import (
    Case,
    Grid,
    Limits,
    RunFunction,
    check_grid,
    environment,
    expand,
    plain_grids,
    runner_identity,
)
from .function_reference import SCRIPT, WORKER_MAIN, FunctionReference
from .store import Store, tables, write_table
from .study_table import StudyTable
from .worker import WorkerSetup

if TYPE_CHECKING:
    import pyarrow as pa

    from ...scene.scene import Scene
    from .cluster import Cluster
    from .worker_pool import WorkerPool


@dataclass(frozen=True)
class Progress:
    """The progress of a sweep."""

    total: int
    """Cases of the study."""
    kept: int
    """Cases whose outcome an earlier run has written."""
    done: int
    """Cases that have an outcome, including those."""
    failed: int
    """Cases of those that failed."""


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
    """Name of the study, in messages and tables."""
    base: str | Path | Scene | None = None
    """Name of a scene, its TOML file, or a Scene made in Python (its body, skin and arm cannot be
    changed); None: no scene, all parameters belong to the run function."""
    grid: Grid | Sequence[Grid] = field(default_factory=dict)
    """Lists of values by dotted key of the scene file, such as "material.young_kpa". "belief.KEY"
    changes only the belief of the owner, "run.KEY" is a parameter of the run function, "method"
    names the estimator. Several grids are run one after the other."""
    seeds: int | Sequence[int] = 1
    """Seeds of each combination, or their number (seeds from 0)."""
    method: str = "joint"
    """Estimator, if the grid names none."""
    run: RunFunction | None = None
    """Computes a case: a function, at the top level of a module, from a Case to values by name. It
    must depend on the case alone. None: simulate, calibrate, assess (evaluate.py)."""
    version: str = ""
    """Part of the key of every case: change it when code that `run` calls has changed. The source
    of `run` and of meshskin is part of the key already."""
    time_limit: float | None = None
    """Limit of the wall time of a case, s."""
    memory_limit: float | None = None
    """Limit of the data segment of a worker process, bytes (Linux only)."""

    def __post_init__(self) -> None:
        for name in ("time_limit", "memory_limit"):
            value = getattr(self, name)
            if value is not None:
                check_real(name, value, above=0.0)
        if self.memory_limit is not None and sys.platform != "linux":
            raise ConfigError("a memory limit works on Linux only", remedy="remove it")
        for seed in self._seeds:
            check_integer("seed", seed, least=0)

    @classmethod
    def load(cls, path: str | Path) -> Study:
        """A study from a TOML file. Raises ConfigError."""
        return cls(**_read(check_path("a study file", path)))

    @property
    def limits(self) -> Limits:
        """The limits of a case."""
        return Limits(self.time_limit, self.memory_limit)

    @property
    def _seeds(self) -> Sequence[int]:
        if isinstance(self.seeds, int):
            return range(self.seeds)
        if isinstance(self.seeds, str) or not isinstance(self.seeds, Iterable):
            raise ConfigError(
                "seeds must be whole numbers, or their number",
                value=repr(self.seeds),
                remedy="give 5 or [1, 7]",
            )
        return [s.item() if isinstance(s, np.integer) else s for s in self.seeds]

    @cached_property
    def _grids(self) -> list[dict[str, list[Any]]]:
        return plain_grids(self.grid)

    @cached_property
    def _run(self) -> RunFunction:
        if self.run is not None:
            return self.run
        from .evaluate import evaluate

        return evaluate

    @cached_property
    def _base(self) -> BaseScene:
        return base_scene(self.base)

    def cases(self) -> list[Case]:
        """All cases, in order. Raises ConfigError for a grid that does not fit the scene."""
        check_grid(self._base, self._grids, self.method)
        runner = runner_identity(self._run, self.version)
        found = list(expand(self._base, self._grids, self._seeds, self.method, runner))
        if not found:
            raise ConfigError(f"the study {self.name} has no cases", remedy="give it seeds")
        if self.run is None and self.base is None:
            raise ConfigError(f"the study {self.name} has no scene", remedy="give it a base")
        return found

    def table(self, out: str | Path) -> pa.Table:
        """The table of the results that the folder `out` holds now, one row per case."""
        store = Store(out)
        return tables((case, store.read(case.key)) for case in self.cases())[0]

    def results(self, out: str | Path) -> StudyTable:
        """The table of the folder `out`, for a notebook: with a card, a figure and `to_pandas`."""
        varied = dict.fromkeys(key for grid in self._grids for key in grid)
        return StudyTable(self.table(out), tuple(varied), self.name)

    def sweep(
        self,
        out: str | Path,
        *,
        workers: int | None = None,
        scheduler: str | None = None,
        retry: bool = False,
        progress: Callable[[Progress], None] | None = None,
    ) -> pa.Table:
        """Run the cases that have no outcome in the folder `out`, and write the tables there.

        Returns the table of results: one row per case, with its parameters, status and results;
        `results` shows it in a notebook. table.csv holds it, too.
        workers: number of processes on this machine (default: one per core); results do not depend
        on it. scheduler: address of a Dask cluster that runs the cases instead. retry: run failed
        cases again. progress: called after each case.
        Raises ConfigError, StudyError (another run writes to `out`, workers cannot start, the
        scheduler is gone), OutputError (a full disk); finished cases are kept.
        """
        if _in_a_worker():
            raise StudyError(
                "a worker process imports this script, which starts the study again",
                remedy='start the study under if __name__ == "__main__":',
            )
        if workers is not None:
            check_integer("workers", workers, least=1)
        setup = WorkerSetup(FunctionReference.to(self._run), self._base, self.limits)
        cases, store = self.cases(), Store(out)
        with store.lock():
            store.describe(self._manifest(len(cases)))
            open_cases, failed = self._open(cases, store, retry)
            size = min(workers or cores(), max(len(open_cases), 1))
            kept = len(cases) - len(open_cases)
            state = Progress(len(cases), kept, kept, failed)
            if progress is not None:
                progress(state)
            with closing(self._executor(setup, size, scheduler)) as executor:
                for outcome in executor.outcomes(
                    replace(case, base=BaseScene()) for case in open_cases
                ):
                    store.write(outcome)
                    failed += bool(outcome.reason)
                    state = replace(state, done=state.done + 1, failed=failed)
                    if progress is not None:
                        progress(state)
            table, times = tables((case, store.read(case.key)) for case in cases)
            write_table(table, store.folder / "table.parquet")
            write_table(times, store.folder / "times.parquet")
            write_table(table, store.folder / "table.csv")
        return table

    def _open(self, cases: list[Case], store: Store, retry: bool) -> tuple[list[Case], int]:
        """The cases to be run, and the number of failed ones among the others."""
        present, failed, out = store.keys(), 0, []
        for case in cases:
            outcome = store.read(case.key) if case.key in present else None
            if outcome is None or (retry and outcome.reason) or not outcome.is_final(self.limits):
                out.append(case)
            else:
                failed += outcome.reason is not None
        return out, failed

    def _executor(
        self, setup: WorkerSetup, size: int, scheduler: str | None
    ) -> WorkerPool | Cluster:
        if scheduler is not None:
            from .cluster import Cluster

            return Cluster(setup, scheduler)
        from .worker_pool import WorkerPool

        return WorkerPool(setup, size)

    def _manifest(self, count: int) -> dict[str, Any]:
        """The definition of the study for study.json; nothing is read back from it."""
        tables = getattr(self._base, "tables", {})
        return {
            "name": self.name,
            "cases": count,
            "base": str(self.base) if isinstance(self.base, str | Path) else tables.get("name"),
            "grid": self._grids,
            "seeds": list(self._seeds),
            "method": self.method,
            "run": f"{self._run.__module__}:{self._run.__qualname__}",
            "version": self.version,
            "time_limit_s": self.time_limit,
            "memory_limit_bytes": self.memory_limit,
            "versions": environment(),
        }


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _in_a_worker() -> bool:
    """Whether a worker process is importing the script that starts the study."""
    frame: Any = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") in (SCRIPT, WORKER_MAIN):
            return True
        frame = frame.f_back
    return False


@dataclass(frozen=True)
class _StudyTable:
    """The keys of a study's TOML file; those of [grid], or of several [[grid]], are those of a
    scene's file."""

    grid: Any
    name: str | None = None
    base: str | None = None
    seeds: Any = 1
    method: str = "joint"
    run: str | None = None
    version: str = ""
    time_limit: float | None = quantity("s", None, above=0.0)
    memory_limit_mb: float | None = quantity("", None, above=0.0)


def _read(path: Path) -> dict[str, Any]:
    """The arguments of Study that a TOML file holds. Raises ConfigError.

    `base` is a scene's name, or a file beside the study's; `run` is `package.module:function`, or
    `file.py:function` beside it.
    """
    table = from_table(_StudyTable, read_toml(path), path.name)
    grids = table.grid if isinstance(table.grid, tuple) else (table.grid,)
    if not all(isinstance(grid, Mapping) for grid in grids):
        raise ConfigError(f"grid in {path.name} must be a table", remedy="write [grid] or [[grid]]")
    if not isinstance(table.seeds, int | tuple):
        raise ConfigError("seeds must be a number or a list", value=repr(table.seeds))
    beside = None if table.base is None else path.parent / table.base
    run = {}
    if table.run is not None:
        run["run"] = FunctionReference.parse(table.run, path.parent).load()
    return {
        "name": table.name or path.stem,
        "base": beside if beside is not None and beside.is_file() else table.base,
        "grid": [dict(_flat(grid)) for grid in grids],
        "seeds": table.seeds,
        "method": table.method,
        "version": table.version,
        "time_limit": table.time_limit,
        "memory_limit": None if table.memory_limit_mb is None else 1e6 * table.memory_limit_mb,
        **run,
    }


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested tables: TOML reads `material.young_kpa = ...` as a table."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
