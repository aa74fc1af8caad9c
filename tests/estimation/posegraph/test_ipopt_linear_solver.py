"""IPOPT's linear solver: the interface of MA57, and MUMPS where it cannot be used."""

import ctypes
from contextlib import contextmanager

import numpy as np
import pytest

from meshskin.estimation.posegraph import ipopt_linear_solver, problem
from meshskin.estimation.posegraph.cholesky import Cholesky

POSES, ANCHOR = 12, 4


@pytest.fixture
def linear_solver():
    """The linear solver of a ring of poses, one of them an anchor."""
    each = np.arange(POSES)
    cholesky = Cholesky(POSES, each, (each + 1) % POSES)
    if cholesky.library is None:
        pytest.skip("no C compiler")
    return ipopt_linear_solver.IpoptLinearSolver(
        cholesky, np.delete(each, ANCHOR), np.array([ANCHOR])
    )


def call(linear_solver, function, *arguments):
    """One of the five functions: numbers by address, arrays as they are."""
    given = [
        a.ctypes.data_as(ctypes.c_void_p)
        if isinstance(a, np.ndarray)
        else ctypes.byref(ctypes.c_int(a))
        for a in arguments
    ]
    getattr(linear_solver._cholesky.library, function)(*given)


class Solver:
    """The functions of MA57 for matrices (6 n, 6 n) of one pattern."""

    def __init__(self, linear_solver, dense):
        n = len(dense)
        # each entry in two halves, one per triangle: both triangles must be accepted
        columns, rows = np.nonzero(np.triu(dense != 0))
        self.linear_solver, self.n, self.entries = linear_solver, n, (rows, columns)
        rows, columns = np.concatenate([rows, columns]), np.concatenate([columns, rows])
        self.rows, self.columns = ((p + 1).astype(np.int32) for p in (rows, columns))
        self.info, self.unused = np.zeros(40, np.int32), np.zeros(40)
        count = len(self.rows)
        self.keep = np.zeros(5 * n + 2 * count + 42, np.int32)
        self.iwork = np.zeros(5 * n, np.int32)
        call(
            linear_solver, "ma57ad_", n, count, self.rows, self.columns, len(self.keep), self.keep,
            self.iwork, self.unused, self.info, self.unused,
        )  # fmt: skip

    def solved(self, dense, right):
        """x, and INFO of the factorization."""
        if self.info[0]:
            return None, self.info
        self.values = np.concatenate([dense[self.entries] / 2] * 2)
        info, unused, n = np.zeros(40, np.int32), self.unused, self.n
        sizes = (1, unused, 1)
        call(
            self.linear_solver, "ma57bd_", n, len(self.values), self.values, unused, *sizes, 1,
            self.keep, self.iwork, unused, unused, info, unused,
        )  # fmt: skip
        factored = info.copy()
        call(
            self.linear_solver, "ma57cd_", 1, n, unused, *sizes, len(right), right, n, unused, 1,
            self.iwork, unused, info,
        )  # fmt: skip
        return right, factored


def solved(linear_solver, dense, right):
    """x, and INFO of the factorization, for one matrix."""
    return Solver(linear_solver, dense).solved(dense, right)


def matrix():
    """A positive definite matrix over the free poses, linked as in the ring."""
    free = np.delete(np.arange(POSES), ANCHOR)
    near = np.abs(free[:, None] - free) % (POSES - 2) <= 1
    random = np.random.default_rng(0).normal(size=(len(free), 6, len(free), 6))
    dense = (random * near[:, None, :, None]).reshape(6 * len(free), 6 * len(free))
    return dense + dense.T + 40 * np.eye(len(dense))


def test_a_system_is_solved(linear_solver):
    dense = matrix()
    right = np.random.default_rng(1).normal(size=(2, len(dense)))
    with linear_solver.activate():
        x, info = solved(linear_solver, dense, right.copy())
    assert info[0] == info[23] == 0
    assert np.allclose(x, np.linalg.solve(dense, right.T).T, rtol=1e-10)


def test_an_indefinite_matrix_is_reported_and_never_solved(linear_solver):
    dense = matrix() - 60 * np.eye(66)
    with linear_solver.activate():
        x, info = solved(linear_solver, dense, np.ones((1, len(dense))))
    assert info[23] == 1
    assert np.isnan(x).all()


def test_factors_of_one_matrix_serve_similar_ones(linear_solver):
    """The error is below 1e-8 in the norm of the matrix; without `similar` each is factorized."""
    dense = matrix()
    other = dense * (1 + 0.1 * np.sin(np.arange(66.0)[:, None] + np.arange(66.0)))
    right = np.random.default_rng(1).normal(size=(2, 66))
    for similar, count in ((True, 1), (False, 2)):
        with linear_solver.activate(similar) as context:
            solver = Solver(linear_solver, dense)
            for one in (dense, other):
                x, info = solver.solved(one, right.copy())
                assert info[0] == info[23] == 0
                off = x.T - np.linalg.solve(one, right.T)
                error = np.sum(off * (one @ off), axis=0)
                size = np.sum(x * right, axis=1)
                assert np.all(error <= (1e-8 if similar else 1e-12) ** 2 * size)
            assert context.factorizations == count


def test_a_matrix_too_different_from_the_first_is_factorized(linear_solver):
    dense, random = matrix(), np.random.default_rng(2).uniform(0.1, 10.0, 66)
    other, right = random[:, None] * dense * random, np.ones((1, 66))
    with linear_solver.activate(similar=True) as context:
        solver = Solver(linear_solver, dense)
        solver.solved(dense, right.copy())
        x, info = solver.solved(other, right.copy())
        assert context.factorizations == 2
        assert info[23] == 0
        assert np.allclose(x, np.linalg.solve(other, right.T).T, rtol=1e-9)
        x, _ = solver.solved(dense - 60 * np.eye(66), right.copy())
        assert np.isnan(x).all()  # indefinite: never solved
        _, info = solver.solved(dense - 60 * np.eye(66), right.copy())
        assert info[23] == 1  # from then on each is factorized, and IPOPT told
        x, _ = solver.solved(dense, right.copy())
        assert np.allclose(x, np.linalg.solve(dense, right.T).T, rtol=1e-9)
        assert context.factorizations == 5


def test_gauss_newton_factorizes_once(skin_graph, monkeypatch):
    """The result is that with a factorization in every iteration."""
    if not ipopt_linear_solver.is_supported():
        pytest.skip("no C compiler")
    original = ipopt_linear_solver.IpoptLinearSolver.activate

    def solution(reuse):
        contexts = []

        @contextmanager
        def recorded(linear_solver, similar=False):
            with original(linear_solver, similar and reuse) as context:
                contexts.append(context)
                yield context

        monkeypatch.setattr(ipopt_linear_solver.IpoptLinearSolver, "activate", recorded)
        return skin_graph(60, seed=3)[0].solve(), [context.factorizations for context in contexts]

    (one, once), (other, every) = solution(True), solution(False)
    assert one.iterations == other.iterations > 1
    assert (once, every) == ([1], [other.iterations])
    assert one.cost == pytest.approx(other.cost, rel=1e-12)
    assert np.allclose(one.poses, other.poses, atol=1e-9)


def test_without_a_context_or_of_another_size_an_error_is_reported(linear_solver):
    dense = matrix()
    assert solved(linear_solver, dense, np.ones((1, len(dense))))[1][0] == -1
    with linear_solver.activate():
        assert solved(linear_solver, dense[:60, :60], np.ones((1, 60)))[1][0] == -1


def test_an_ipopt_that_cannot_load_the_solver_uses_mumps(skin_graph, monkeypatch):
    loaded = skin_graph(40, seed=1)[0].solve()
    monkeypatch.setattr(ipopt_linear_solver, "is_supported", lambda: False)
    monkeypatch.setattr(problem, "topology_cache", problem.TopologyCache(1))
    graph = skin_graph(40, seed=1)[0]
    assert graph.problem("log")._linear_solver.options == {}
    mumps = graph.solve()
    assert mumps.is_optimal
    assert mumps.iterations == loaded.iterations
    assert np.allclose(mumps.poses, loaded.poses, atol=1e-12)


def test_the_previous_context_is_restored(linear_solver):
    """`is_supported` runs a solver of its own: afterwards the other's context is set again."""
    dense = matrix()
    with linear_solver.activate():
        assert ipopt_linear_solver.is_supported.__wrapped__()
        _, info = solved(linear_solver, dense, np.ones((1, len(dense))))
    assert info[0] == 0
    assert solved(linear_solver, dense, np.ones((1, len(dense))))[1][0] == -1


def test_ipopt_loads_the_solver(linear_solver, monkeypatch):
    assert ipopt_linear_solver.is_supported()
    assert linear_solver.options["linear_solver"] == "ma57"
    monkeypatch.setattr(
        ipopt_linear_solver, "_options", lambda library: {"linear_solver": "no such solver"}
    )
    assert not ipopt_linear_solver.is_supported.__wrapped__()
