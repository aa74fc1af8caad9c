"""The door for IPOPT: the convention of MA57, and what happens to one that does not come in."""

import ctypes

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
    return ma57.Door(cholesky, np.delete(each, HELD), np.array([HELD]))


def call(door, function, *arguments):
    """One of the five functions: numbers by address, arrays as they are."""
    given = [
        a.ctypes.data_as(ctypes.c_void_p)
        if isinstance(a, np.ndarray)
        else ctypes.byref(ctypes.c_int(a))
        for a in arguments
    ]
    getattr(door._cholesky.built, function)(*given)


def solved(door, dense, right):
    """x, and INFO of the factorisation, for a matrix (6 n, 6 n) given by one triangle."""
    n = len(dense)
    # Each entry in two halves, one of them in the other triangle: both must be understood.
    columns, rows = np.nonzero(np.triu(dense != 0))
    places = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    values = np.concatenate([dense[rows, columns] / 2] * 2)
    rows, columns = ((p + 1).astype(np.int32) for p in places)
    count, info, unused = len(rows), np.zeros(40, np.int32), np.zeros(40)
    keep, aside = np.zeros(5 * n + 2 * count + 42, np.int32), np.zeros(5 * n, np.int32)
    call(door, "ma57ad_", n, count, rows, columns, len(keep), keep, aside, unused, info, unused)
    if info[0]:
        return None, info
    sizes = (1, unused, 1)
    call(
        door, "ma57bd_", n, count, values, unused, *sizes, 1, keep, aside, unused, unused, info,
        unused,
    )  # fmt: skip
    factored = info.copy()
    call(
        door, "ma57cd_", 1, n, unused, *sizes, len(right), right, n, unused, 1, aside, unused, info
    )
    return right, factored


def matrix(door):
    """A positive definite matrix over the free poses, linked as in the ring."""
    free = np.delete(np.arange(POSES), HELD)
    near = np.abs(free[:, None] - free) % (POSES - 2) <= 1
    random = np.random.default_rng(0).normal(size=(len(free), 6, len(free), 6))
    dense = (random * near[:, None, :, None]).reshape(6 * len(free), 6 * len(free))
    return dense + dense.T + 40 * np.eye(len(dense))


def test_a_system_is_solved(door):
    dense = matrix(door)
    right = np.random.default_rng(1).normal(size=(2, len(dense)))
    with door.open():
        x, info = solved(door, dense, right.copy())
    assert info[0] == info[23] == 0
    assert np.allclose(x, np.linalg.solve(dense, right.T).T, rtol=1e-10)


def test_an_indefinite_matrix_is_reported_and_never_solved(door):
    dense = matrix(door) - 60 * np.eye(66)
    with door.open():
        x, info = solved(door, dense, np.ones((1, len(dense))))
    assert info[23] == 1
    assert np.isnan(x).all()


def test_without_a_plan_or_of_another_size_nothing_is_done(door):
    dense = matrix(door)
    assert solved(door, dense, np.ones((1, len(dense))))[1][0] == -1
    with door.open():
        assert solved(door, dense[:60, :60], np.ones((1, 60)))[1][0] == -1


def test_an_ipopt_that_stays_outside_keeps_mumps(skin_graph, monkeypatch):
    inside = skin_graph(40, seed=1)[0].solve()
    monkeypatch.setattr(ma57, "_comes_in", lambda: False)
    monkeypatch.setattr(topology, "kept", topology.Kept(1))
    graph = skin_graph(40, seed=1)[0]
    assert graph.problem("log")._door.options == {}
    outside = graph.solve()
    assert outside.is_optimal
    assert outside.iterations == inside.iterations
    assert np.allclose(outside.poses, inside.poses, atol=1e-12)


def test_plans_are_handed_back(door):
    """A solver that is tried while another waits: the other's plan is there again."""
    dense = matrix(door)
    with door.open():
        assert ma57._comes_in.__wrapped__()
        _, info = solved(door, dense, np.ones((1, len(dense))))
    assert info[0] == 0
    assert solved(door, dense, np.ones((1, len(dense))))[1][0] == -1


def test_ipopt_does_come_in(door, monkeypatch):
    assert ma57._comes_in()
    assert door.options["linear_solver"] == "ma57"
    monkeypatch.setattr(ma57, "_named", lambda library: {"linear_solver": "no such solver"})
    assert not ma57._comes_in.__wrapped__()
