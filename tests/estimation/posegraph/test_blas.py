"""SciPy's BLAS under the name of CasADi's: the same poses, and the triangle product it lacks."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from meshskin import compiled
from meshskin.estimation.posegraph import blas

ROOT = Path(__file__).parents[3]
SOLVE = """
import sys
import casadi as ca
if sys.argv[1] == "after":  # IPOPT loaded before, with CasADi's own BLAS
    x = ca.SX.sym("x")
    ca.nlpsol("s", "ipopt", {"x": x, "f": x * x}, {"ipopt.print_level": 0})
from tests.estimation.posegraph.conftest import make_graph
from meshskin.estimation.posegraph.blas import use_scipys_blas
solution = make_graph(60)[0].solve()
print(use_scipys_blas(), solution.status, f"{solution.cost:.9g}")
"""
needs_linux = pytest.mark.skipif(
    not sys.platform.startswith("linux") or compiled._compiler() is None,
    reason="the shim is for Linux with a C compiler",
)


def solved(when: str, **environment: str) -> list[str]:
    run = subprocess.run(
        [sys.executable, "-c", SOLVE, when],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        check=True,
    )
    return run.stdout.split()


@needs_linux
def test_same_poses_with_either():
    ours, theirs = solved("first", MESHSKIN_BLAS="scipy"), solved("first", MESHSKIN_BLAS="")
    late = solved("after", MESHSKIN_BLAS="scipy")
    kept = solved("first", MESHSKIN_BLAS="", MESHSKIN_MALLOC="keep")
    assert theirs[0] == "False"
    assert ours[1:] == theirs[1:] == late[1:] == kept[1:]
    assert ours[1] == "optimal"


@needs_linux
@pytest.mark.parametrize("uplo", ["L", "U"])
@pytest.mark.parametrize("trans", ["NN", "NT", "TN", "TT"])
def test_triangle_product(uplo, trans):
    text = "\n".join(
        [
            *(blas._passed_on(*f) for f in blas._functions() if f[0] == "dgemm"),
            blas.MISSING.read_text(),
            "void *table[] = {&its_dgemm};",
        ]
    )
    library = compiled.library("gemmt", text, (*compiled.FLAGS, "-w"))
    (address,) = (f[3] for f in blas._functions() if f[0] == "dgemm")
    table = (ctypes.c_void_p * 1).in_dll(library, "table")
    ctypes.c_void_p.from_address(table[0]).value = address
    rng, n, k = np.random.default_rng(0), 150, 7
    a, b = rng.normal(size=(n, k)), rng.normal(size=(k, n))
    given = [np.asfortranarray(m.T if t == "T" else m) for m, t in zip((a, b), trans, strict=True)]
    for beta in (0.0, 0.5):
        c = np.asfortranarray(rng.normal(size=(n, n)))
        cut = np.tril if uplo == "L" else np.triu
        expected = c - cut(c) + cut(2.0 * a @ b + beta * c)
        letters = [ctypes.c_char(letter.encode()) for letter in (uplo, *trans)]
        integers = [ctypes.c_int(v) for v in (n, k, len(given[0]), len(given[1]), n)]
        reals = [ctypes.c_double(v) for v in (2.0, beta)]
        by = ctypes.byref
        pa, pb, pc = (ctypes.c_void_p(m.ctypes.data) for m in (*given, c))
        (size, inner, lda, ldb, ldc), (alpha, scale) = map(by, integers), map(by, reals)
        library.dgemmt_(*map(by, letters), size, inner, alpha, pa, lda, pb, ldb, scale, pc, ldc)
        assert np.allclose(c, expected, atol=1e-12)
