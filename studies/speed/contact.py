"""Errors of the contact models against reference solutions, and time per contact.

    OMP_NUM_THREADS=1 python studies/speed/contact.py [--out DIR]

hertz, elliptic, layered: batches of 10,000 contacts. elliptic: compared with root finding on the
exact equations, and with tamaas on a grid. layered: compared with the boundary elements from which
its table comes, at random points of the table (and with finite elements in the tests). field: one
scene on 96 x 96 cells, compared with the ellipse and, for a layer, with 288 x 288 cells. several:
contacts per query on a torus of 20,000 faces. discs: the mean over the taxel.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import multi_contact
import numpy as np
import results

from meshskin import Body, contact
from meshskin.contact import boundary_elements, disc, ellipse, elliptic, layered

COUNT = 10_000
CASE: dict = {"force": 1.0, "indenter_radius": 0.01, "modulus": 1e6, "poisson": 0.45}
E_STAR = 1e6 / (1 - 0.45**2)


def main() -> dict[str, float]:
    """Print the figures, one a line, and give them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    results.add_out(parser)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    found = batches(rng) | accuracy(rng) | fields() | discs(rng) | queries()
    for name, value in found.items():
        print(f"{name:44s} {value:10.3g}")
    rows = {name: {"time": value} for name, value in found.items() if " us" in name}
    results.write(options.out, "contact", found, rows, "time (us)")
    return found


def batches(rng: np.random.Generator) -> dict[str, float]:
    """Microseconds a contact, batched, for the patch and for the force of a depth."""
    force, depth = rng.uniform(0.1, 1.0, COUNT), rng.uniform(1e-5, 2e-4, COUNT)
    curvature = rng.uniform(-20.0, 30.0, (COUNT, 2))
    out = {}
    for model in contact.BATCHED:
        given: dict[str, Any] = {
            "curvature": curvature,
            "indenter_radius": 0.01,
            "effective_modulus": E_STAR,
        }
        law = contact.ContactModel(model, poisson=0.45, thickness=2e-3)
        patch = best(partial(law.patches, force=force, **given))
        push = best(partial(law.force, depth=depth, **given))
        out[f"{model}: patch, us a contact"] = 1e6 * patch / COUNT
        out[f"{model}: force of a depth, us a contact"] = 1e6 * push / COUNT
    return out


def accuracy(rng: np.random.Generator) -> dict[str, float]:
    """Largest relative errors of elliptic and layered."""
    log_ratio = rng.uniform(0.0, np.log(elliptic.MAX_CURVATURE_RATIO), 1000)
    pairs = np.stack([np.zeros(1000), 100 * np.expm1(log_ratio)], axis=1)
    many = elliptic.patches(1.0, pairs, 0.01, E_STAR)
    aspect, size, sink = np.array([elliptic.exact_factors(t) for t in log_ratio]).T
    radius = 2 / (200 + pairs.sum(axis=1))
    circle = (0.75 * radius / E_STAR) ** (1 / 3)
    errors = (
        many.first / (circle * size * np.exp(log_ratio * aspect / 2)) - 1,
        many.depth / (circle**2 / radius * sink) - 1,
    )
    out = {"elliptic: largest error to the equations": float(np.abs(errors).max())}
    if find_spec("tamaas"):
        out["elliptic: error in p_0 to tamaas, 256^2"] = tamaas_error()
    for column, name in enumerate(("a", "p_0", "depth")):
        out[f"layered: largest error in {name} to field"] = float(table_errors()[:, column].max())
    return out


def table_errors() -> np.ndarray:
    """Errors (12, 3) of the layered factors at random points of the table, to 192 x 192 cells."""
    rng, rows = np.random.default_rng(1), []
    for _ in range(12):
        chi, poisson = float(np.exp(rng.uniform(np.log(0.1), np.log(10)))), rng.uniform(0.0, 0.5)
        case = CASE | {"poisson": poisson, "curvature": 0.0}
        a = float(contact.solve("elliptic", **case).semi_axes[0])
        whole = boundary_elements.solve(contact.ContactProblem(**case), parabolic=True, cells=192)
        thin = boundary_elements.solve(
            contact.ContactProblem(**case, thickness=a / chi), parabolic=True, cells=192
        )
        made = (
            thin.semi_axes[0] / whole.semi_axes[0],
            thin.peak / whole.peak,
            thin.depth / whole.depth,
        )
        found = np.array(layered.BondedLayer(poisson, 1.0).factors(np.array(chi))[:3])
        rows.append(np.abs(found / made - 1))
    return np.array(rows)


def tamaas_error(n: int = 256) -> float:
    """Relative difference of the elliptic peak from tamaas' at the same places."""
    import tamaas

    tamaas.set_log_level(tamaas.LogLevel.error)
    exact = contact.solve("elliptic", curvature=(60.0, -20.0), **CASE)
    side = 2.3 * float(exact.semi_axes[0])
    x = ((np.arange(n) + 0.5) / n - 0.5) * side
    gap = boundary_elements.sphere_gap(x[:, None], x[None], (-20.0, 60.0), 0.01, True)
    model = tamaas.ModelFactory.createModel(tamaas.model_type.basic_2d, [side, side], [n, n])
    model.E, model.nu = CASE["modulus"], CASE["poisson"]
    tamaas.ModelFactory.registerNonPeriodic(model, "dcfft")
    solver = tamaas.PolonskyKeerRey(model, -gap, 1e-12)
    solver.setIntegralOperator("dcfft")
    solver.solve(1.0 / side**2)
    middle = np.array([x[n // 2], x[n // 2]])
    return abs(float(np.array(model.traction).max() / exact.pressure(middle)) - 1)


def fields() -> dict[str, float]:
    """Error in p_0 and milliseconds of one boundary-element solve, the grid's search included."""
    out = {}
    for name, thickness in (("half-space", None), ("layer", 2e-3)):
        case = contact.ContactProblem(curvature=(60.0, 0.0), thickness=thickness, **CASE)
        found = boundary_elements.solve(case, parabolic=True)
        peak = (
            contact.solve("elliptic", curvature=(60.0, 0.0), **CASE).peak
            if thickness is None
            else boundary_elements.solve(case, parabolic=True, cells=288).peak
        )
        out[f"field: error in p_0, {name}"] = abs(found.peak / peak - 1)
        out[f"field: ms, {name}"] = 1e3 * best(
            partial(boundary_elements.solve, case, parabolic=True), 5
        )
    return out


def discs(rng: np.random.Generator) -> dict[str, float]:
    """Microseconds a disc mean."""
    x, y, a, b = (rng.uniform(0.5, 2.0, COUNT) for _ in range(4))
    return {
        "disc mean, circle: us": 1e6 * best(lambda: disc.disc_mean(x, a)) / COUNT,
        "disc mean, ellipse: us": 1e6 * best(lambda: ellipse.ellipse_mean(x, y, a, b, 1.0)) / COUNT,
        "disc mean, ellipse, any exponent: us": 1e6
        * best(lambda: ellipse.ellipse_mean(x, y, a, b, 1.0, a))
        / COUNT,
    }


def queries() -> dict[str, float]:
    """Milliseconds to find the contacts of a sphere, shallow and deep."""
    body = Body.torus(0.05, 0.02, faces=20_000)
    multi_contact.find_contacts(body, [0.079, 0.0, 0.0], 0.01)
    return {
        f"several: ms a query, {depth} mm deep": 1e3
        * best(
            partial(multi_contact.find_contacts, body, [0.08 - 1e-3 * depth, 0.0, 0.0], 0.01), 20
        )
        for depth in (0.3, 1.0, 5.0)
    }


def best(run: Callable[[], object], repeats: int = 7) -> float:
    """Shortest time in s of some runs, after a first one that fills the caches."""
    run()
    times = []
    for _ in range(repeats):
        started = perf_counter()
        run()
        times.append(perf_counter() - started)
    return min(times)


if __name__ == "__main__":
    main()
