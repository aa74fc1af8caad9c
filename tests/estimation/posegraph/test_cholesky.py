"""Cholesky factorization, compiled and by SuperLU, against dense matrices."""

import ctypes
import threading

import numpy as np
import pytest
from scipy.sparse import csr_array

from meshskin.estimation.posegraph import cholesky as module
from meshskin.estimation.posegraph import symbolic_factorization as ordering
from meshskin.estimation.posegraph.cholesky import Cholesky
from meshskin.estimation.posegraph.symbolic_factorization import symbolic_factorization
from meshskin.estimation.posegraph.symmetric_blocks import SingularMatrixError, SymmetricBlocks

N = 40


def use_metis(metis, monkeypatch):
    if not metis:
        monkeypatch.setattr(ordering, "pymetis", None)
    elif ordering.pymetis is None:
        pytest.skip("pymetis is not installed")


def links(kind):
    rng = np.random.default_rng(0)
    pairs = {
        "chain": [(k, k + 1) for k in range(N - 1)],
        "star": [(0, k) for k in range(1, N)],
        "grid": [(k, k + 1) for k in range(N - 1) if (k + 1) % 8] + [(k, k + 8) for k in range(32)],
        "random": [tuple(rng.choice(N, 2, replace=False)) for _ in range(120)],
        "full": [(j, i) for i in range(N) for j in range(i)],
        "disconnected": [(k, k + 1) for k in range(19)] + [(k, k + 1) for k in range(22, N - 1)],
        "none": [],
    }[kind]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


KINDS = ("chain", "star", "grid", "random", "full", "disconnected", "none")


def positive(pairs, size, seed=0):
    """A random positive definite matrix with these links, and the same dense."""
    rng = np.random.default_rng(seed)
    i, j = pairs.T
    jacobian = rng.normal(size=(len(i), size, 2 * size))
    h = np.swapaxes(jacobian, 1, 2) @ jacobian
    matrix = SymmetricBlocks(
        np.concatenate([i, j, i]),
        np.concatenate([i, j, j]),
        np.concatenate([h[:, :size, :size], h[:, size:, size:], h[:, :size, size:]]),
    ).add_diagonal(np.tile(1e-2 * np.eye(size), (N, 1, 1)))
    dense = np.zeros((N, size, N, size))
    for row, column, block in zip(matrix.rows, matrix.columns, matrix.values, strict=True):
        dense[row, :, column, :] += block
        if row != column:
            dense[column, :, row, :] += block.T
    return matrix, dense.reshape(N * size, N * size)


@pytest.fixture(params=["compiled", "superlu"])
def make(request):
    """Makes a `Cholesky` of pairs (m, 2), compiled or by SuperLU."""

    def made(pairs):
        found = Cholesky(N, *pairs.T)
        if request.param == "superlu":
            found.library = None
        elif found.library is None:
            pytest.skip("no C compiler")
        return found

    return made


@pytest.mark.parametrize("size", [1, 3, 4, 6])
@pytest.mark.parametrize("kind", KINDS)
def test_solution_and_inverse_are_those_of_the_dense_matrix(kind, size, make):
    pairs = links(kind)
    matrix, dense = positive(pairs, size)
    system = make(pairs)
    right = np.random.default_rng(1).normal(size=(N, size, 3))
    given = right.copy()
    solved = system.solve(matrix, right).reshape(N * size, 3)
    expected = np.linalg.solve(dense, right.reshape(N * size, 3))
    assert np.allclose(solved, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
    assert np.array_equal(right, given)
    inverse = np.linalg.inv(dense).reshape(N, size, N, size)
    each = np.arange(N)
    found = system.diagonal_of_inverse(matrix, 1e-13)
    assert np.allclose(found, inverse[each, :, each, :], rtol=1e-9, atol=1e-9)
    assert np.allclose((matrix @ right).reshape(N * size, 3), dense @ right.reshape(N * size, 3))
    assert np.allclose(matrix.diagonal(N).ravel(), np.diagonal(dense))


@pytest.mark.parametrize("kind", ["chain", "grid", "random", "none"])
@pytest.mark.parametrize("share", [1e-9, 1e-5, 1e-1])
def test_definiteness_is_the_sign_of_the_smallest_eigenvalue(kind, share, make):
    pairs = links(kind)
    matrix, dense = positive(pairs, 3)
    smallest, largest = np.linalg.eigvalsh(dense)[[0, -1]]
    system = make(pairs)
    for sign in (-1, 1):
        move = np.tile((sign * share * largest - smallest) * np.eye(3), (N, 1, 1))
        assert system.is_positive_definite(matrix.add_diagonal(move)) == (sign > 0)


def test_nan_is_not_positive_definite(make):
    pairs = links("grid")
    matrix, _ = positive(pairs, 6)
    matrix.values[7, 2, 2] = np.nan
    assert not make(pairs).is_positive_definite(matrix)


def test_a_singular_node_is_named(make):
    pairs = links("grid")
    matrix, _ = positive(pairs, 6)
    alone = matrix.values.copy()
    alone[(matrix.rows == 13) | (matrix.columns == 13)] *= np.where(np.arange(6) == 4, 0.0, 1.0)
    alone[(matrix.rows == 13) | (matrix.columns == 13), 4] = 0.0
    with pytest.raises(SingularMatrixError, match="node 13") as caught:
        make(pairs).diagonal_of_inverse(SymmetricBlocks(matrix.rows, matrix.columns, alone), 1e-13)
    assert caught.value.node == 13


@pytest.mark.parametrize(("pivot", "singular"), [(1e-15, True), (1e-9, False)])
def test_a_pivot_of_rounding_is_singular(pivot, singular, make):
    values = np.concatenate([np.ones(N + 1), [pivot]])[:, None, None]
    each = np.arange(N)
    matrix = SymmetricBlocks(np.append(each, [1, 1]), np.append(each, [0, 1]), values)
    system = make(np.array([[0, 1]]))
    if singular:
        with pytest.raises(SingularMatrixError):
            system.diagonal_of_inverse(matrix, 1e-13)
    else:
        assert np.isclose(system.diagonal_of_inverse(matrix, 1e-13)[1, 0, 0] * pivot, 1, rtol=1e-5)


def test_threads_may_share_a_factorization():
    pairs = links("grid")
    system = Cholesky(N, *pairs.T)
    tasks = [(positive(pairs, 6, seed), np.full((N, 6, 1), seed + 1.0)) for seed in range(4)]
    found = [np.empty(0)] * len(tasks)

    def run(k):
        (matrix, _), right = tasks[k]
        for _ in range(20):
            found[k] = system.solve(matrix, right)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(len(tasks))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for ((_, dense), right), solved in zip(tasks, found, strict=True):
        assert np.allclose(dense @ solved.ravel(), right.ravel(), atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("metis", [True, False])
def test_fronts_cover_the_fill(kind, metis, monkeypatch):
    """Every entry of the factor is in the front of its column; subtrees are contiguous."""
    use_metis(metis, monkeypatch)
    pairs = links(kind)
    found = symbolic_factorization(N, *pairs.T)
    assert np.array_equal(np.sort(found.order), np.arange(N))
    assert np.array_equal(found.order[found.position], np.arange(N))
    _, dense = positive(pairs, 1)
    factor = np.linalg.cholesky(dense[np.ix_(found.order, found.order)])
    for f in range(len(found.parent)):
        rows = found.rows[found.start[f] : found.start[f + 1]]
        own = rows[: found.pivots[f]]
        assert (found.front[own] == f).all()
        assert np.isin(np.flatnonzero(np.abs(factor[:, own]).max(axis=1) > 1e-12), rows).all()
        if found.parent[f] >= 0:
            parent = found.parent[f]
            above = found.rows[found.start[parent] : found.start[parent + 1]]
            rest = slice(found.start[f] + found.pivots[f], found.start[f + 1])
            assert np.array_equal(above[found.parent_row[rest]], found.rows[rest])
            assert parent - found.subtree[parent] < f - found.subtree[f] + 1 <= f < parent


@pytest.mark.parametrize("metis", [True, False])
def test_orders_of_elimination_fill_little(metis, monkeypatch):
    use_metis(metis, monkeypatch)
    n, side = 400, 20
    pairs = np.array(
        [(k, k + 1) for k in range(n - 1) if (k + 1) % side]
        + [(k, k + side) for k in range(n - side)]
    )
    ordered = symbolic_factorization(n, *pairs.T)
    monkeypatch.setattr(
        "meshskin.estimation.posegraph.symbolic_factorization.elimination_order", natural
    )
    assert ordered.panel[-1] < 0.7 * symbolic_factorization(n, *pairs.T).panel[-1]


def natural(pattern: csr_array) -> np.ndarray:
    return np.arange(pattern.shape[0])


def test_wide_integers_of_a_blas_are_refused(monkeypatch):
    """Without 32-bit integers cholesky.c cannot be used: SuperLU is."""
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype = ctypes.py_object
    capsule.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    name = b"void (char *, int64_t *, double *)"
    offered = {key: capsule(1, name, None) for keys in module.BLAS.values() for key in keys}

    class Wide:
        __pyx_capi__ = offered

    monkeypatch.setattr(module.importlib, "import_module", lambda name: Wide)
    assert module._blas_functions() is None
