"""Limits on the threads of linear algebra."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from meshskin.core.blas import single_threaded
from meshskin.estimation.posegraph import PoseGraph
from meshskin.estimation.posegraph import solve as solving


def threads():
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


@pytest.fixture
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("the BLAS does not run on two threads")
        yield


def test_one_thread_inside_and_the_former_number_after(two_threads):
    with single_threaded():
        assert threads() == {1}
        with single_threaded():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {2}
    with pytest.raises(ZeroDivisionError), single_threaded():
        1 / 0  # noqa: B018
    assert threads() == {2}


def test_a_pose_graph_is_solved_on_one_thread(two_threads, monkeypatch):
    seen, minimize = [], solving.minimize

    def observed(*args, **options):
        seen.append(threads())
        return minimize(*args, **options)

    monkeypatch.setattr(solving, "minimize", observed)
    eyes = np.tile(np.eye(4), (3, 1, 1))
    solution = PoseGraph(eyes, np.array([[0, 1], [1, 2]]), eyes[:2], np.eye(6)).solve()
    assert solution.certificate.certified
    assert seen == [{1}, {1}]
    assert threads() == {2}
