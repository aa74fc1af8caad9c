"""Compiled functions: equal to interpreted ones, cached by content, private, never damaged."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from meshskin.core import codegen as module
from meshskin.core.codegen import cache_folder, compile_function

needs_compiler = pytest.mark.skipif(module.find_compiler() is None, reason="no C compiler here")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.delenv("MESHSKIN_COMPILER", raising=False)
    monkeypatch.setenv("MESHSKIN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def example(scale=1.0):
    x = ca.SX.sym("x", 3)
    y = scale * ca.sin(x[0]) * x[1] ** 2 + ca.atan2(x[2], x[0])
    gradient = ca.gradient(y, x)
    function = ca.Function("example", [x], [y, gradient], ["x"], ["y", "gradient"])
    return function, ca.Function("example_hessian", [x], [ca.tril(ca.jacobian(gradient, x))])


@needs_compiler
def test_compiled_equals_interpreted_with_its_derivatives(cache):
    x = [0.3, -1.2, 2.0]
    for function in example():
        fast = compile_function(function)
        assert fast.class_name() == "External" != function.class_name()
        assert (fast.name(), fast.name_in(), fast.name_out()) == (
            function.name(),
            function.name_in(),
            function.name_out(),
        )
        for ours, reference in zip(fast.call([x]), function.call([x]), strict=True):
            assert ours.sparsity() == reference.sparsity()
            assert np.allclose(ours.full(), reference.full(), rtol=1e-15)
        twice = fast.map(2).call([ca.horzcat(x, x)])[0].full()
        assert np.array_equal(twice, np.tile(fast.call([x])[0].full(), 2))


@needs_compiler
def test_libraries_are_cached_by_content(cache):
    compile_function(example()[0])
    library = next(cache.rglob("*.so"))
    before = library.stat().st_mtime_ns
    compile_function(example()[0])
    assert list(cache.rglob("*.so")) == [library]
    assert library.stat().st_mtime_ns == before
    compile_function(example(scale=2.0)[0])
    assert len(list(cache.rglob("*.so"))) == 2


@needs_compiler
def test_a_cached_library_must_have_been_built(cache):
    text = "int answer(void) { return 42; }"
    assert module.cached_library(text) is None
    module.compile_library("answer", text)
    assert module.cached_library(text).answer() == 42
    assert module.cached_library(text, (*module.FLAGS, "-O1")) is None  # flags are part of the key


@pytest.mark.deep
@needs_compiler
@pytest.mark.parametrize("damage", ["half", "not a library"])
def test_a_damaged_library_is_rebuilt(cache, damage):
    # In a process of its own: the file must not be one that this process has mapped.
    call(cache)
    library = next(cache.rglob("*.so"))
    whole = library.read_bytes()
    library.unlink()
    damaged = {"half": whole[: len(whole) // 2], "not a library": b"text"}[damage]
    name = module.content_hash(damaged) if damage == "not a library" else library.stem
    library.with_name(f"{name}.so").write_bytes(damaged)
    assert call(cache) == "External 4.0"
    (rebuilt,) = cache.rglob("*.so")
    assert module.content_hash(rebuilt.read_bytes()) == rebuilt.stem


@pytest.mark.deep
@needs_compiler
def test_of_several_processes_at_once_one_compiles(cache, monkeypatch, tmp_path):
    compiler, calls = tmp_path / "cc", tmp_path / "calls"
    compiler.write_text(f'#!/bin/sh\necho >> {calls}\nexec {module.find_compiler()} "$@"\n')
    compiler.chmod(0o700)
    monkeypatch.setenv("MESHSKIN_COMPILER", str(compiler))
    runs = [start(cache) for _ in range(4)]
    assert {run.communicate()[0].strip() for run in runs} == {"External 4.0"}
    assert not [p for p in cache.rglob("*") if p.is_file() and p.suffix != ".so"]
    assert calls.read_text() == "\n"


@needs_compiler
def test_unwritable_cache_uses_a_temporary_folder(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("MESHSKIN_CACHE", str(blocked / "cache"))
    assert compile_function(example()[0]).class_name() == "External"


@pytest.mark.parametrize("compiler", ["none", "no-such-compiler"])
def test_without_compiler_interpreted_and_warned_once(cache, monkeypatch, compiler):
    monkeypatch.setenv("MESHSKIN_COMPILER", compiler)
    module._warn_once.cache_clear()
    function = example()[0]
    with pytest.warns(RuntimeWarning, match="no C compiler"):
        assert compile_function(function) is function
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compile_function(function) is function
    assert not cache.exists()


def test_a_compiler_that_fails_is_named(cache, monkeypatch):
    false = next((p for p in ("/bin/false", "/usr/bin/false") if Path(p).exists()), None)
    if false is None:
        pytest.skip("no `false` here")
    monkeypatch.setenv("MESHSKIN_COMPILER", false)
    module._warn_once.cache_clear()
    function = example()[0]
    with pytest.warns(RuntimeWarning, match="cannot compile 'example'"):
        assert compile_function(function) is function


@needs_compiler
def test_a_compiler_that_does_not_run_is_named(cache, monkeypatch, tmp_path):
    broken = tmp_path / "cc"
    broken.write_bytes(b"\x7fELF no program")
    broken.chmod(0o700)
    monkeypatch.setenv("MESHSKIN_COMPILER", str(broken))
    module._warn_once.cache_clear()
    function = example()[0]
    with pytest.warns(RuntimeWarning, match="cc cannot compile 'example'.*it does not run"):
        assert compile_function(function) is function


@needs_compiler
def test_a_user_without_a_home_compiles_in_a_temporary_folder(monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    for name in ("MESHSKIN_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert cache_folder() is None
    assert module.cached_library("int answer(void) { return 42; }") is None
    assert compile_function(example()[0]).class_name() == "External"


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of POSIX")
def test_the_cache_is_private(cache):
    cache.mkdir()
    cache.chmod(0o777)
    compile_function(example()[0])
    library = next(cache.rglob("*.so"))
    for path in (cache, library.parent, library):
        assert path.stat().st_mode & 0o777 == 0o700


def plant(cache: Path, source: str) -> Path:
    """A library that answers 13 in the place of `source` in the cache."""
    other = "int answer(void) { return 13; }"
    module.compile_library("planted", other)
    module.compile_library("answer", source)
    keys = [module._key(text, module.find_compiler(), module.FLAGS) for text in (other, source)]
    (planted,), (library,) = ((cache / key).glob("*.so") for key in keys)
    library.unlink()
    return planted.rename(library.with_name(planted.name))


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of POSIX")
def test_a_library_that_others_may_write_is_built_anew(cache):
    source = "int answer(void) { return 42; } /* writable */"
    plant(cache, source).chmod(0o777)
    assert module.cached_library(source) is None
    assert module.compile_library("answer", source).answer() == 42


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of POSIX")
@pytest.mark.parametrize("target", ["root", "folder", "library"])
def test_a_cache_of_another_user_is_not_loaded(cache, monkeypatch, target):
    source = f"int answer(void) {{ return 42; }} /* {target} */"
    library = plant(cache, source)
    if os.getuid() == 0:
        path = {"root": cache, "folder": library.parent, "library": library}[target]
        os.chown(path, 12345, -1)
    else:  # this process becomes another user, as whom it owns no folder at all
        monkeypatch.setattr(os, "getuid", lambda: 12345)
        module._warn_once()
    assert module.cached_library(source) is None
    built = module.compile_library("answer", source)
    assert built is None or built.answer() == 42


def test_cache_folder_follows_the_platform(monkeypatch, tmp_path):
    monkeypatch.delenv("MESHSKIN_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache_folder() == tmp_path / "meshskin"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "meshskin"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache_folder() == Path.home() / "Library" / "Caches" / "meshskin"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert cache_folder() == tmp_path / "local" / "meshskin"


SQUARE = """
import casadi as ca
from meshskin.core.codegen import compile_function
x = ca.SX.sym("x")
f = compile_function(ca.Function("square", [x], [x * x]))
print(f.class_name(), float(f(2)))
"""


def start(cache: Path) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "MESHSKIN_CACHE": str(cache),
        "PYTHONPATH": str(Path(module.__file__).parents[2]),
    }
    return subprocess.Popen(
        [sys.executable, "-c", SQUARE], stdout=subprocess.PIPE, text=True, env=environment
    )


def call(cache: Path) -> str:
    return start(cache).communicate()[0].strip()
