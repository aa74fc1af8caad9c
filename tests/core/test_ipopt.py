"""IPOPT with functions of NumPy arrays, on Rosenbrock's function and a constrained parabola."""

import casadi as ca
import numpy as np
import pytest

from meshskin.core import ipopt


def rosenbrock():
    """The program, and its cost with gradient and Hessian as functions of arrays."""
    x = ca.MX.sym("x", 2)
    cost = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    gradient = ca.Function("g", [x], [cost, ca.gradient(cost, x)])
    hessian = ca.Function("h", [x], [ca.hessian(cost, x)[0]])

    def write(function):
        def evaluate(inputs, outputs):
            for value, out in zip(function(inputs[0]), outputs, strict=False):
                if out is not None:
                    out[:] = value

        return evaluate

    dense, one, none = ca.Sparsity.dense(2), ca.Sparsity.dense(1), ca.Sparsity(0, 1)
    f = ipopt.BufferCallback(
        "f", [dense, none], [one], write(lambda v: [gradient(v)[0].full().ravel()])
    )
    grad_f = ipopt.BufferCallback(
        "grad_f",
        [dense, none],
        [one, dense],
        write(lambda v: [o.full().ravel() for o in gradient(v)]),
    )

    def curvature(inputs, outputs):
        if outputs[0] is not None:
            upper = hessian(inputs[0]).full()
            outputs[0][:] = inputs[2] * np.array([upper[0, 0], upper[0, 1], upper[1, 1]])

    hess = ipopt.BufferCallback(
        "hess_lag", [dense, none, one, none], [ca.Sparsity.upper(2)], curvature
    )
    p = ca.MX.sym("p", none)
    return {"x": x, "p": p, "f": f(x, p)}, grad_f, hess, f


def test_functions_of_arrays_reach_the_minimum():
    nlp, gradient, hessian, _cost = rosenbrock()
    path = []
    callback = ipopt.IterationCallback(2, 0, lambda x, g: path.append(x))
    solver = ipopt.solver(
        "test", nlp, {"tol": 1e-10}, gradient=gradient, hessian=hessian, callback=callback
    )
    run = ipopt.BufferedFunction(solver)
    free = np.full(2, np.inf)
    x = run(np.array([-1.2, 1.0]), np.zeros(0), -free, free)[0]
    assert x == pytest.approx([1.0, 1.0], abs=1e-8)
    assert run.stats()["success"]
    assert len(path) == run.stats()["iter_count"] + 1
    np.testing.assert_array_equal(path[0], [-1.2, 1.0])


def test_a_callback_sees_the_constraints_and_stops():
    x = ca.MX.sym("x", 2)
    nlp = {"x": x, "f": ca.sumsqr(x - 2), "g": ca.vertcat(x[0] + x[1])}
    seen = []

    def iterate(values, constraints):
        seen.append(constraints[0] - values.sum())
        return len(seen) == 3

    callback = ipopt.IterationCallback(2, 1, iterate)
    solver = ipopt.solver("stop", nlp, {}, callback=callback)
    solver(x0=[0.0, 0.0], ubg=1.0, lbg=-np.inf)
    assert solver.stats()["return_status"] == "User_Requested_Stop"
    assert seen == pytest.approx([0.0] * 3, abs=1e-12)
