"""A reference to a run function that another process can import."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

from ...core.errors import StudyError
from .case import RunFunction

SCRIPT = "__meshskin_worker__"
"""`__name__` of a script that is imported to find a function in it."""
WORKER_MAIN = "__mp_main__"
"""`__name__` of the main script in a worker process, as multiprocessing imports it."""
_REMEDY = "define it with def at the top of a module or script"


@dataclass(frozen=True)
class FunctionReference:
    """The name of a function at the top level of a module or of a script."""

    name: str
    module: str | None = None
    script: str | None = None

    @classmethod
    def to(cls, run: RunFunction) -> FunctionReference:
        """The reference to a function. Raises StudyError if it is not at the top level."""
        module, name = getattr(run, "__module__", None), getattr(run, "__qualname__", None)
        home = sys.modules.get(str(module))
        if name is None or home is None or getattr(home, str(name), None) is not run:
            raise StudyError("workers cannot import the run function", value=run, remedy=_REMEDY)
        if module == SCRIPT:
            return cls(name, script=home.__file__)
        if module != "__main__":
            return cls(name, module=module)
        spec, file = getattr(home, "__spec__", None), getattr(home, "__file__", None)
        if spec is not None:  # python -m package.module
            return cls(name, module=spec.name)
        if file is None:
            raise StudyError("workers cannot import the run function", value=run, remedy=_REMEDY)
        return cls(name, script=str(Path(file).resolve()))

    @classmethod
    def parse(cls, text: str, folder: Path) -> FunctionReference:
        """Parse `package.module:function` or `file.py:function`, a file in `folder`.

        Raises StudyError.
        """
        module, _, name = text.partition(":")
        if not module or not name:
            raise StudyError(
                "run must name a module and a function",
                value=repr(text),
                remedy="write package.module:function or file.py:function",
            )
        if module.endswith(".py"):
            return cls(name, script=str((folder / module).resolve()))
        return cls(name, module=module)

    def load(self) -> RunFunction:
        """The function. Raises StudyError."""
        if self.script is not None and not Path(self.script).is_file():
            raise StudyError("cannot read the script of the run function", value=self.script)
        home = self.script or str(self.module)
        try:
            found = import_module(home) if self.script is None else _imported(home)
        except ModuleNotFoundError as error:
            raise StudyError(
                f"cannot import the run function: {error}",
                remedy="install its package or set PYTHONPATH",
            ) from error
        except (Exception, SystemExit) as error:  # the user's own code may raise anything
            raise StudyError(
                f"cannot import the run function from {home}",
                value=f"{type(error).__name__}: {error}",
                remedy="run it by itself with python, and correct the error",
            ) from error
        run: RunFunction | None = getattr(found, self.name, None)
        if not callable(run):
            raise StudyError(f"no function {self.name} in {home}")
        return run


def _imported(script: str) -> ModuleType:
    """A script as a module, without what it does as `__main__`."""
    main = sys.modules.get(WORKER_MAIN)  # multiprocessing has imported the main script already
    if main is not None and getattr(main, "__file__", None) == script:
        return main
    module = ModuleType(SCRIPT)
    module.__file__ = script
    sys.modules[SCRIPT] = module
    SourceFileLoader(SCRIPT, script).exec_module(module)
    return module
