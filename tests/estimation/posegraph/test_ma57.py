"""The door for IPOPT: the convention of MA57, and what happens to one that does not come in."""

import ctypes
from contextlib import contextmanager

import numpy as np
import pytest

from meshskin.estimation.posegraph import ma57, topology
from meshskin.estimation.posegraph.cholesky import Cholesky

POSES, HELD = 12, 4


@pytest.fixture
def door():
    """Of a ring of poses, one of them held."""
    each = np.arange(POSES)
    cholesky = Cholesky(POSES, each, (each + 1) % POSES)
    if cholesky.built is None:
        pytest.skip("no C compiler")
    return ma57.IpoptLinearSolver(cholesky, np.delete(each, HELD), np.array([HELD]))


def call(door, function, *arguments):
    """One of the five functions: numbers by address, arrays as they are."""
    given = [
        a.ctypes.data_as(ctypes.c_void_p)
        if isinstance(a, np.ndarray)
        else ctypes.byref(ctypes.c_int(a))
        for a in arguments
    ]
    getattr(door._cholesky.built, function)(*given)


class Solver:
    """The five functions for matrices (6 n, 6 n) of one pattern, given by one triangle."""

    def __init__(self, door, dense):
        n = len(dense)
        # Each entry in two halves, one of them in the other triangle: both must be understood.
        columns, rows = np.nonzero(np.triu(dense != 0))
        self.door, self.n, self.places = door, n, (rows, columns)
        rows, columns = np.concatenate([rows, columns]), np.concatenate([columns, rows])
        self.rows, self.columns = ((p + 1).astype(np.int32) for p in (rows, columns))
        self.info, self.unused = np.zeros(40, np.int32), np.zeros(40)
        count = len(self.rows)
        self.keep = np.zeros(5 * n + 2 * count + 42, np.int32)
        self.aside = np.zeros(5 * n, np.int32)
        call(
            door, "ma57ad_", n, count, self.rows, self.columns, len(self.keep), self.keep,
            self.aside, self.unused, self.info, self.unused,
        )  # fmt: skip

    def solved(self, dense, right):
        """x, and INFO of the factorisation."""
        if self.info[0]:
            return None, self.info
        self.values = np.concatenate([dense[self.places] / 2] * 2)
        info, unused, n = np.zeros(40, np.int32), self.unused, self.n
        sizes = (1, unused, 1)
        call(
            self.door, "ma57bd_", n, len(self.values), self.values, unused, *sizes, 1, self.keep,
            self.aside, unused, unused, info, unused,
        )  # fmt: skip
        factored = info.copy()
        call(
            self.door, "ma57cd_", 1, n, unused, *sizes, len(right), right, n, unused, 1, self.aside,
            unused, info,
        )  # fmt: skip
        return right, factored


def solved(door, dense, right):
    """x, and INFO of the factorisation, for one matrix."""
    return Solver(door, dense).solved(dense, right)


def matrix():
    """A positive definite matrix over the free poses, linked as in the ring."""
    free = np.delete(np.arange(POSES), HELD)
    near = np.abs(free[:, None] - free) % (POSES - 2) <= 1
    random = np.random.default_rng(0).normal(size=(len(free), 6, len(free), 6))
    dense = (random * near[:, None, :, None]).reshape(6 * len(free), 6 * len(free))
    return dense + dense.T + 40 * np.eye(len(dense))


def test_a_system_is_solved(door):
    dense = matrix()
    right = np.random.default_rng(1).normal(size=(2, len(dense)))
    with door.open():
        x, info = solved(door, dense, right.copy())
    assert info[0] == info[23] == 0
    assert np.allclose(x, np.linalg.solve(dense, right.T).T, rtol=1e-10)


def test_an_indefinite_matrix_is_reported_and_never_solved(door):
    dense = matrix() - 60 * np.eye(66)
    with door.open():
        x, info = solved(door, dense, np.ones((1, len(dense))))
    assert info[23] == 1
    assert np.isnan(x).all()


def test_factors_of_one_matrix_serve_those_that_are_like_it(door):
    """To nine digits, in the matrix's norm; they are eliminated where that is asked for."""
    dense = matrix()
    other = dense * (1 + 0.1 * np.sin(np.arange(66.0)[:, None] + np.arange(66.0)))
    right = np.random.default_rng(1).normal(size=(2, 66))
    for alike, count in ((True, 1), (False, 2)):
        with door.open(alike) as plan:
            solver = Solver(door, dense)
            for one in (dense, other):
                x, info = solver.solved(one, right.copy())
                assert info[0] == info[23] == 0
                off = x.T - np.linalg.solve(one, right.T)
                error = np.sum(off * (one @ off), axis=0)
                size = np.sum(x * right, axis=1)
                assert np.all(error <= (1e-8 if alike else 1e-12) ** 2 * size)
            assert plan.eliminations == count


def test_a_matrix_that_is_not_like_the_first_is_eliminated_after_all(door):
    dense, random = matrix(), np.random.default_rng(2).uniform(0.1, 10.0, 66)
    other, right = random[:, None] * dense * random, np.ones((1, 66))
    with door.open(alike=True) as plan:
        solver = Solver(door, dense)
        solver.solved(dense, right.copy())
        x, info = solver.solved(other, right.copy())
        assert plan.eliminations == 2
        assert info[23] == 0
        assert np.allclose(x, np.linalg.solve(other, right.T).T, rtol=1e-9)
        x, _ = solver.solved(dense - 60 * np.eye(66), right.copy())
        assert np.isnan(x).all()  # an indefinite one is not what was promised: never solved
        _, info = solver.solved(dense - 60 * np.eye(66), right.copy())
        assert info[23] == 1  # from then on each is eliminated, and IPOPT told
        x, _ = solver.solved(dense, right.copy())
        assert np.allclose(x, np.linalg.solve(dense, right.T).T, rtol=1e-9)
        assert plan.eliminations == 5


def test_gauss_newton_eliminates_once(skin_graph, monkeypatch):
    """And ends where it ends with an elimination in every iteration."""
    if not ma57.is_supported():
        pytest.skip("no C compiler")
    usual = ma57.IpoptLinearSolver.open

    def solution(reuse):
        plans = []

        @contextmanager
        def watched(door, alike=False):
            with usual(door, alike and reuse) as plan:
                plans.append(plan)
                yield plan

        monkeypatch.setattr(ma57.IpoptLinearSolver, "open", watched)
        return skin_graph(60, seed=3)[0].solve(), [plan.eliminations for plan in plans]

    (one, once), (other, every) = solution(True), solution(False)
    assert one.iterations == other.iterations > 1
    assert (once, every) == ([1], [other.iterations])
    assert one.cost == pytest.approx(other.cost, rel=1e-12)
    assert np.allclose(one.poses, other.poses, atol=1e-9)


def test_without_a_plan_or_of_another_size_nothing_is_done(door):
    dense = matrix()
    assert solved(door, dense, np.ones((1, len(dense))))[1][0] == -1
    with door.open():
        assert solved(door, dense[:60, :60], np.ones((1, 60)))[1][0] == -1


def test_an_ipopt_that_stays_outside_keeps_mumps(skin_graph, monkeypatch):
    inside = skin_graph(40, seed=1)[0].solve()
    monkeypatch.setattr(ma57, "is_supported", lambda: False)
    monkeypatch.setattr(topology, "kept", topology.TopologyCache(1))
    graph = skin_graph(40, seed=1)[0]
    assert graph.problem("log")._door.options == {}
    outside = graph.solve()
    assert outside.is_optimal
    assert outside.iterations == inside.iterations
    assert np.allclose(outside.poses, inside.poses, atol=1e-12)


def test_plans_are_handed_back(door):
    """A solver that is tried while another waits: the other's plan is there again."""
    dense = matrix()
    with door.open():
        assert ma57.is_supported.__wrapped__()
        _, info = solved(door, dense, np.ones((1, len(dense))))
    assert info[0] == 0
    assert solved(door, dense, np.ones((1, len(dense))))[1][0] == -1


def test_ipopt_does_come_in(door, monkeypatch):
    assert ma57.is_supported()
    assert door.options["linear_solver"] == "ma57"
    monkeypatch.setattr(ma57, "_named", lambda library: {"linear_solver": "no such solver"})
    assert not ma57.is_supported.__wrapped__()
