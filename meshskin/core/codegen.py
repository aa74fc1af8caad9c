"""CasADi functions through the C compiler, cached by content.

A compiled function runs several times faster than CasADi's virtual machine. The shared object is
kept under the user's cache folder (`MESHSKIN_CACHE` overrides it) and found again by the hash of
its C source, the compiler, the flags and the platform. Its file name carries the hash of its own
bytes, so that a torn file is never loaded. Without a C compiler (or with `MESHSKIN_COMPILER=none`)
everything still works, interpreted.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import casadi as ca

T = TypeVar("T")

INLINE = Path(__file__).with_name("inline.h").read_text(encoding="utf-8")
"""C text that goes before code that runs at every step: headers, and fmax and fmin as one
instruction each."""
FLAGS = ("-O3", "-fno-math-errno", "-shared", "-fPIC")
"""Of the compiler. No -march=native, of which the cache's key knows nothing: see `fused`."""
PLAIN = ("-O0", "-shared", "-fPIC")
"""For long code that is run a few times."""


def compile_function(function: ca.Function, flags: tuple[str, ...] = FLAGS) -> ca.Function:
    """`function` as machine code: same name, inputs and outputs.

    The result has no derivatives of its own: compile a Jacobian or Hessian as a function by itself.
    Where there is no C compiler, or it refuses the source, `function` itself is returned and one
    warning is given per process.
    """
    name = function.name()
    return _machine_code(name, lambda: c_source(function), _external(name), flags) or function


def compile_with_derivatives(function: ca.Function, directions: int) -> ca.Function:
    """`function` as machine code with forward derivatives in 1 and in `directions` directions.

    Derivatives are long: the compiler is not asked to be clever, which would take it ten times as
    long as it takes to translate. Without a C compiler, see `compiled`.
    """
    name = function.name()
    slopes = [function.forward(count) for count in sorted({1, directions})]
    made = _machine_code(name, lambda: c_source(function, *slopes), _external(name), PLAIN)
    return made or function


def compile_library(name: str, text: str, flags: tuple[str, ...] = FLAGS) -> ctypes.CDLL | None:
    """The shared library of C source `text`, in the same cache; None, and one warning, without.

    `name` is for the warning. CasADi functions that the source calls come from `source`.
    """
    return _machine_code(name, lambda: text, _loaded, flags)


def cached_library(text: str, flags: tuple[str, ...] = FLAGS) -> ctypes.CDLL | None:
    """The shared library of C source `text` if `library` left it in the cache before; else None."""
    compiler = find_compiler()
    if compiler is None:
        return None
    try:
        return _cached(_loaded, cache_folder() / _key(text, compiler, flags))
    except OSError:  # an unreadable cache is no cache
        return None


@functools.cache
def fma_flags() -> tuple[str, ...]:
    """Flags for fused multiply-add and vectors of four, where this processor has them.

    Flags are part of the cache's key, so that a folder shared by several machines serves each.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        return ()
    try:
        told = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore")
    except OSError:
        return ()
    flags = next((line.split() for line in told.splitlines() if line.startswith("flags")), [])
    return ("-mavx2", "-mfma") if {"avx2", "fma"} <= set(flags) else ()


def c_source(*functions: ca.Function) -> str:
    """C source of `functions`: the code that CasADi generates."""
    import casadi as ca

    generator = ca.CodeGenerator(f"{functions[0].name()}.c")
    for function in functions:
        generator.add(function)
    return str(generator.dump())


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


def find_compiler() -> str | None:
    """The C compiler to use, or None; `MESHSKIN_COMPILER` names another, or none."""
    chosen = os.environ.get("MESHSKIN_COMPILER", "")
    if chosen.lower() == "none":
        return None
    names = (chosen,) if chosen else ("cc", "gcc", "clang")
    return next(filter(None, map(shutil.which, names)), None)


def _machine_code(
    name: str, text: Callable[[], str], load: Callable[[str], T], flags: tuple[str, ...]
) -> T | None:
    """What `load` makes of the shared library of C source `text`; None where there is none."""
    compiler = find_compiler()
    if compiler is None:
        _warn("no C compiler found: functions are interpreted, several times slower")
        return None
    written = text()
    key = _key(written, compiler, flags)
    for folder in (cache_folder() / key, _temporary_folder() / key):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            found = _cached(load, folder)
            return found or load(str(_built(written, folder, compiler, flags)))
        except OSError:  # an unwritable or full cache: build in a folder of this process
            continue
        except subprocess.CalledProcessError as error:
            reason = (
                error.stderr.decode(errors="replace").strip() or f"exit code {error.returncode}"
            )
        except RuntimeError as error:  # built, but cannot be loaded
            reason = str(error)
        _warn(f"{compiler} cannot compile {name!r}, interpreted instead: {reason}")
        return None
    _warn(f"no folder to compile in: {name!r} is interpreted, several times slower")
    return None


def _external(name: str) -> Callable[[str], ca.Function]:
    import casadi as ca

    return lambda path: ca.external(name, path)


def _loaded(path: str) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(path)
    except OSError as error:
        raise RuntimeError(str(error)) from error


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
    return content_hash("\0".join(parts + machine).encode())


def content_hash(data: bytes) -> str:
    """The name that a library with these bytes has in the cache."""
    return hashlib.sha256(data).hexdigest()[:32]


def _cached(load: Callable[[str], T], folder: Path) -> T | None:
    """What `load` makes of the first whole library in `folder`; torn ones are removed."""
    for file in sorted(folder.glob("*.so")):
        if content_hash(file.read_bytes()) == file.stem:
            try:
                return load(str(file))
            except RuntimeError:  # whole, but not loadable here: build it again
                pass
        file.unlink(missing_ok=True)
    return None


def _built(source: str, folder: Path, compiler: str, flags: tuple[str, ...]) -> Path:
    """Compile in a scratch folder beside the goal, then move the library into place at once."""
    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as scratch:
        code, made = Path(scratch) / "code.c", Path(scratch) / "code.so"
        code.write_text(source, encoding="utf-8")
        command = [compiler, *flags, str(code), "-o", str(made), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        goal = folder / f"{content_hash(made.read_bytes())}.so"
        os.replace(made, goal)
    return goal


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
