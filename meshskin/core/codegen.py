"""CasADi functions and C source compiled to machine code, cached by content.

A compiled function runs several times faster than CasADi's virtual machine. Shared libraries are
kept in the user's cache folder (environment variable `MESHSKIN_CACHE`), in a folder named by the
hash of their C source, the compiler, the flags and the platform. The file name is the hash of the
library's own bytes, so that a damaged file is not loaded. Folders and files that another user owns
or may write are not used. Without a C compiler, or with `MESHSKIN_COMPILER=none`, functions are
interpreted.

CasADi's own just-in-time compilation (the option `jit`) was weighed: it compiles in every process.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import casadi as ca

T = TypeVar("T")

INLINE = Path(__file__).with_name("inline.h").read_text(encoding="utf-8")
"""C source placed before code that runs at every step: headers, and fmax and fmin as one
instruction each."""
FLAGS = ("-O3", "-fno-math-errno", "-shared", "-fPIC")
"""Flags of the compiler. There is no -march=native, which the key of the cache could not tell apart
on several machines: see `fma_flags`."""
PLAIN = ("-O0", "-shared", "-fPIC")
"""Flags for long code that runs a few times: -O3 takes ten times as long to compile it."""


def compile_function(function: ca.Function) -> ca.Function:
    """`function` as machine code, with the same name, inputs and outputs.

    The result has no derivatives: compile a Jacobian or Hessian as a function of its own. Without a
    C compiler, or where it fails, `function` itself is returned, with one warning per process.
    """
    return _compiled(function, [], FLAGS)


def compile_with_derivatives(function: ca.Function, directions: int) -> ca.Function:
    """`function` as `compile_function`, with forward derivatives in 1 and in `directions`
    directions. It is compiled without optimization.
    """
    return _compiled(function, [function.forward(k) for k in sorted({1, directions})], PLAIN)


def compile_library(name: str, text: str, flags: tuple[str, ...] = FLAGS) -> ctypes.CDLL | None:
    """The shared library of C source `text`; `name` is for warnings.

    Without a C compiler, or where it fails, None, with one warning per process.
    """
    return _machine_code(name, lambda: text, _load, flags)


def cached_library(text: str, flags: tuple[str, ...] = FLAGS) -> ctypes.CDLL | None:
    """The shared library of C source `text` if it is in the cache, otherwise None."""
    compiler, root = find_compiler(), cache_folder()
    if compiler is None or root is None:
        return None
    try:
        folder = root / _key(text, compiler, flags)
        return _cached(_load, folder) if _is_private(root) and _is_private(folder) else None
    except OSError:  # not in the cache, or not readable
        return None


@functools.cache
def fma_flags() -> tuple[str, ...]:
    """Flags for fused multiply-add and vectors of four, if this processor has them.

    Flags are part of the key of the cache, so that machines may share a folder.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        return ()
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore")
    except OSError:
        return ()
    flags = next((line.split() for line in text.splitlines() if line.startswith("flags")), [])
    return ("-mavx2", "-mfma") if {"avx2", "fma"} <= set(flags) else ()


def c_source(*functions: ca.Function) -> str:
    """The C source that CasADi generates for functions."""
    import casadi as ca

    generator = ca.CodeGenerator(f"{functions[0].name()}.c")
    for function in functions:
        generator.add(function)
    return str(generator.dump())


def cache_folder() -> Path | None:
    """The user's cache folder of the platform, or `MESHSKIN_CACHE`; None for a user without one."""
    if chosen := os.environ.get("MESHSKIN_CACHE"):
        return Path(chosen)
    try:
        if sys.platform == "win32":
            base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        elif sys.platform == "darwin":
            base = Path.home() / "Library" / "Caches"
        else:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # no HOME, and a user id without an account
        return None
    return base / "meshskin"


def find_compiler() -> str | None:
    """The path of the C compiler, or None; `MESHSKIN_COMPILER` names another one, or "none"."""
    chosen = os.environ.get("MESHSKIN_COMPILER", "")
    if chosen.lower() == "none":
        return None
    names = (chosen,) if chosen else ("cc", "gcc", "clang")
    return next(filter(None, map(shutil.which, names)), None)


def _machine_code(
    name: str, text: Callable[[], str], load: Callable[[str], T], flags: tuple[str, ...]
) -> T | None:
    """The shared library of C source `text()`, opened by `load`; None if it cannot be built."""
    compiler = find_compiler()
    if compiler is None:
        _warn("no C compiler found: functions are interpreted, several times slower")
        return None
    source = text()
    key = _key(source, compiler, flags)
    for root in (cache_folder, _temporary_folder):
        try:
            folder = _private_folder(root(), key)
            if made := _cached(load, folder):
                return made
            with _locked(folder):  # another process may have built it meanwhile
                built = _cached(load, folder)
                return built or load(str(_build(source, folder, compiler, flags)))
        except OSError:  # a cache folder that is full or not ours: build in a temporary folder
            continue
        except RuntimeError as error:
            _warn(f"{compiler} cannot compile {name!r}, interpreted instead: {error}")
            return None
    _warn(f"no folder to compile in: {name!r} is interpreted, several times slower")
    return None


def _compiled(
    function: ca.Function, derivatives: list[ca.Function], flags: tuple[str, ...]
) -> ca.Function:
    """`function` and its derivatives as machine code, or `function` itself."""
    import casadi as ca

    name = function.name()
    made = _machine_code(
        name, lambda: c_source(function, *derivatives), lambda path: ca.external(name, path), flags
    )
    return made or function


def _load(path: str) -> ctypes.CDLL:
    """Opens a shared library. Raises RuntimeError."""
    try:
        return ctypes.CDLL(path)
    except OSError as error:
        raise RuntimeError(str(error)) from error


def _key(source: str, compiler: str, flags: tuple[str, ...]) -> str:
    """Hash of all that determines the machine code."""
    import casadi as ca

    binary = Path(compiler).resolve()
    status = binary.stat()
    parts = (
        source,
        ca.CasadiMeta.version(),
        str(binary),
        str(status.st_size),
        str(status.st_mtime_ns),
        *flags,
    )
    machine = (sys.platform, platform.machine())
    return content_hash("\0".join(parts + machine).encode())


def content_hash(data: bytes) -> str:
    """The name in the cache of a library with these bytes."""
    return hashlib.sha256(data).hexdigest()[:32]


def _is_private(path: Path) -> bool:
    """Whether only this user, or root, owns and may write a file or folder. Raises OSError."""
    if not hasattr(os, "getuid"):  # Windows: the user's folders are private by their inheritance
        return True
    status = path.stat()
    return status.st_uid in (0, os.getuid()) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _private_folder(root: Path | None, key: str) -> Path:
    """The folder `key` in `root`, both made with mode 0700. Raises OSError if they are not ours."""
    if root is None:
        raise FileNotFoundError("this user has no cache folder")
    for folder in (root, root / key):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder):
            if folder.stat().st_uid != os.getuid():
                raise PermissionError(f"{folder} belongs to another user")
            folder.chmod(0o700)
    return root / key


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lets one process at a time build in `folder`, where the system can lock folders."""
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):  # Windows: each process builds
        yield
        return
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _cached(load: Callable[[str], T], folder: Path) -> T | None:
    """The first intact and private library in `folder`, opened by `load`; others are removed."""
    for file in sorted(folder.glob("*.so")):
        if _is_private(file) and content_hash(file.read_bytes()) == file.stem:
            try:
                return load(str(file))
            except RuntimeError:  # intact, but not loadable on this machine: build it again
                pass
        file.unlink(missing_ok=True)
    return None


def _build(source: str, folder: Path, compiler: str, flags: tuple[str, ...]) -> Path:
    """Compile in a scratch folder in `folder`, and move the library into `folder` at once.

    Raises RuntimeError if the compiler fails or does not run, OSError if `folder` is not writable.
    """
    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as scratch:
        code, made = Path(scratch) / "code.c", Path(scratch) / "code.so"
        code.write_text(source, encoding="utf-8")
        command = [compiler, *flags, str(code), "-o", str(made), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True)
        except subprocess.CalledProcessError as error:
            output = error.stderr.decode(errors="replace").strip()
            raise RuntimeError(output or f"exit code {error.returncode}") from error
        except OSError as error:
            raise RuntimeError(f"it does not run: {error.strerror}") from error
        made.chmod(0o700)
        goal = folder / f"{content_hash(made.read_bytes())}.so"
        os.replace(made, goal)
    return goal


@functools.cache
def _temporary_folder() -> Path:
    """A folder of this process, removed at its end."""
    folder = Path(tempfile.mkdtemp(prefix="meshskin-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.cache
def _warn_once() -> None:
    """Called before the one warning of this process; see `_warn`."""


def _warn(message: str) -> None:
    """Warn, the first time in this process."""
    if _warn_once.cache_info().currsize == 0:
        _warn_once()
        warnings.warn(message, RuntimeWarning, stacklevel=3)
