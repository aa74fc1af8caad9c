"""The table of the layered contact model, computed with boundary elements.

A rigid paraboloid is pressed on an elastic layer bonded to a rigid base, for a grid of
y = chi / (1 + chi), chi = a_Hertz / thickness, and Poisson's ratios, both at Chebyshev points. Each
row holds the ratios of contact radius, peak pressure and approach to Hertz's on a half-space of the
same E*, and the ratio of ln(a/b) to Hertz's for relative curvatures 2 : 1. At chi = 0 all are 1.
Deterministic; runs two minutes.

    OMP_NUM_THREADS=1 python studies/layer_table.py [--cells 192] [--out FILE]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from meshskin import contact
from meshskin.contact import ContactProblem, boundary_elements, layered
from meshskin.contact.array_backend import chebyshev_nodes
from meshskin.core.atomic_io import write_text

CASE: dict = {"force": 1.0, "indenter_radius": 0.01, "modulus": 1e6}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the table as CSV."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cells", type=int, default=192)
    parser.add_argument("--out", type=Path, default=layered.TABLE)
    options = parser.parse_args(arguments)
    y = layered.MAX_CHI / (1 + layered.MAX_CHI) * (1 + chebyshev_nodes(layered.CHIS)) / 2
    ratios = 0.25 * (1 + chebyshev_nodes(layered.POISSONS))
    lines = ["chi,poisson,radius,peak,depth,aspect"]
    for chi in y / (1 - y):
        for poisson in ratios:
            values = factors(float(chi), float(poisson), options.cells)
            lines.append(",".join(f"{v:.8g}" for v in (chi, poisson, *values)))
    write_text(options.out, "\n".join(lines) + "\n")


def factors(chi: float, poisson: float, cells: int = 192) -> tuple[float, ...]:
    """Contact radius, peak pressure, approach and ln(a/b) on a layer, in parts of Hertz's."""
    if chi == 0:
        return 1.0, 1.0, 1.0, 1.0
    # the grid's own error, the same for the half-space, cancels in the quotients
    found, whole = (press(0.0, chi, poisson, cells), press(0.0, 0.0, poisson, cells))
    long, long_whole = (press(100.0, c, poisson, cells).semi_axes for c in (chi, 0.0))
    return (
        edge(found) / edge(whole),
        found.peak / whole.peak,
        found.depth / whole.depth,
        float(np.log(long[0] / long[1]) / np.log(long_whole[0] / long_whole[1])),
    )


def press(curvature: float, chi: float, poisson: float, cells: int) -> boundary_elements.GridPatch:
    """The patch for curvatures (`curvature`, 0), 1/m, on a layer of sqrt(a b)_Hertz / chi."""
    case = CASE | {"poisson": poisson, "curvature": (curvature, 0.0)}
    size = float(np.sqrt(np.prod(contact.solve("elliptic", **case).semi_axes)))
    thickness = size / chi if chi > 0 else None
    return boundary_elements.solve(
        ContactProblem(**case, thickness=thickness), cells=cells, parabolic=True
    )


def edge(patch: boundary_elements.GridPatch) -> float:
    """Contact radius, m, finer than a cell: where p^2, a polynomial in r^2 there, goes to zero."""
    assert patch.grid is not None
    (n, m), (dx, dy) = patch.grid.shape, patch.spacing
    x, y = (np.arange(n) - (n - 1) / 2) * dx, (np.arange(m) - (m - 1) / 2) * dy
    a = float(patch.semi_axes[0])
    square = (x[:, None] ** 2 + y**2) / a**2
    near = (square > 0.36) & (square < (1 - 2.5 * dx / a) ** 2)
    values = (patch.grid[near] / patch.peak) ** 2
    fit = np.polynomial.Polynomial.fit(square[near], values, 4)
    roots = fit.roots()
    real = roots[np.abs(roots.imag) < 1e-9].real
    return a * float(np.sqrt(real[np.argmin(np.abs(real - 1))]))


if __name__ == "__main__":
    main()
