"""CasADi functions through the C compiler, cached by content.

A compiled function runs several times faster than CasADi's virtual machine. The shared object is
kept under the user's cache folder (`MESHSKIN_CACHE` overrides it) and found again by the hash of
its C source, the compiler, the flags and the platform. Its file name carries the hash of its own
bytes, so that a torn file is never loaded. Without a C compiler (or with `MESHSKIN_COMPILER=none`)
everything still works, interpreted.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import casadi as ca

FLAGS = ("-O3", "-fno-math-errno", "-shared", "-fPIC")
# No -march=native: a cache folder may be shared by machines with different processors.


def compiled(function: ca.Function, flags: tuple[str, ...] = FLAGS) -> ca.Function:
    """`function` as machine code: same name, inputs and outputs.

    The result has no derivatives of its own: compile a Jacobian or Hessian as a function by itself.
    Where there is no C compiler, or it refuses the source, `function` itself is returned and one
    warning is given per process.
    """
    compiler = _compiler()
    if compiler is None:
        _warn("no C compiler found: CasADi functions are interpreted, several times slower")
        return function
    source = _source(function)
    key = _key(source, compiler, flags)
    for folder in (cache_folder() / key, _temporary_folder() / key):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            found = _cached(function.name(), folder)
            return found or _built(function.name(), source, folder, compiler, flags)
        except OSError:  # an unwritable or full cache: build in a folder of this process
            continue
        except subprocess.CalledProcessError as error:
            reason = (
                error.stderr.decode(errors="replace").strip() or f"exit code {error.returncode}"
            )
        except RuntimeError as error:  # casadi.external: built, but cannot be loaded
            reason = str(error)
        _warn(f"{compiler} cannot compile {function.name()!r}, interpreted instead: {reason}")
        return function
    _warn(f"no folder to compile in: {function.name()!r} is interpreted, several times slower")
    return function


def cached(function: ca.Function, flags: tuple[str, ...] = FLAGS) -> ca.Function | None:
    """`function` as machine code if `compiled` left it in the cache before; else None."""
    compiler = _compiler()
    if compiler is None:
        return None
    folder = cache_folder() / _key(_source(function), compiler, flags)
    try:
        return _cached(function.name(), folder)
    except OSError:  # an unreadable cache is no cache
        return None


def cache_folder() -> Path:
    """The user's cache folder for compiled functions, by the rule of the platform."""
    if chosen := os.environ.get("MESHSKIN_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "meshskin"


def _compiler() -> str | None:
    """The C compiler to use, or None; `MESHSKIN_COMPILER` names another, or none."""
    chosen = os.environ.get("MESHSKIN_COMPILER", "")
    if chosen.lower() == "none":
        return None
    names = (chosen,) if chosen else ("cc", "gcc", "clang")
    return next(filter(None, map(shutil.which, names)), None)


def _source(function: ca.Function) -> str:
    import casadi as ca

    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    return str(generator.dump())


def _key(source: str, compiler: str, flags: tuple[str, ...]) -> str:
    """Content hash: whatever could change the machine code."""
    import casadi as ca

    binary = Path(compiler).resolve()
    stat = binary.stat()
    parts = (
        source,
        ca.CasadiMeta.version(),
        str(binary),
        str(stat.st_size),
        str(stat.st_mtime_ns),
        *flags,
    )
    machine = (sys.platform, platform.machine())
    return _hash("\0".join(parts + machine).encode())


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def _cached(name: str, folder: Path) -> ca.Function | None:
    """The function from the first whole library in `folder`; torn ones are removed."""
    import casadi as ca

    for library in sorted(folder.glob("*.so")):
        if _hash(library.read_bytes()) == library.stem:
            try:
                return ca.external(name, str(library))
            except RuntimeError:  # whole, but not loadable here: build it again
                pass
        library.unlink(missing_ok=True)
    return None


def _built(
    name: str, source: str, folder: Path, compiler: str, flags: tuple[str, ...]
) -> ca.Function:
    """Compile in a scratch folder beside the goal, then move the library into place at once."""
    import casadi as ca

    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as scratch:
        code, library = Path(scratch) / "code.c", Path(scratch) / "code.so"
        code.write_text(source)
        command = [compiler, *flags, str(code), "-o", str(library), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        goal = folder / f"{_hash(library.read_bytes())}.so"
        os.replace(library, goal)
    return ca.external(name, str(goal))


@functools.cache
def _temporary_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="meshskin-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.cache
def _warn_once() -> None:
    """Called before the one warning of this process; see `_warn`."""


def _warn(message: str) -> None:
    """Warn the first time in this process."""
    if _warn_once.cache_info().currsize == 0:
        _warn_once()
        warnings.warn(message, RuntimeWarning, stacklevel=3)
