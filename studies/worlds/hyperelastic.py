"""A rubber layer on a rigid spherical core, pressed by a rigid sphere: finite elements, scikit-fem.

Compressible neo-Hookean material, W = mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2, large
deformations, axisymmetric about the contact point, biquadratic elements. The indenter has no
friction; the base is bonded to the core or slides on it. Contact is a penalty on the boundary's
quadrature points in the reference configuration, so that pressures are those on the undeformed
skin, whose points the taxels are. Source: Bonet and Wood, Nonlinear Continuum Mechanics for Finite
Element Analysis (2008), sections 6.4.3 and 9.2.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import skfem
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import splu

from meshskin.core.atomic_io import atomic
from meshskin.core.codegen import cache_folder

from .profiles import REACH, Array, Tabulated

TOLERANCE, MAX_ITERATIONS, MAX_MOVE = 1e-10, 40, 2e-4
"""Newton's method: move of the points, m, after which it stops; iterations; largest move in one of
them, m."""


@dataclass(frozen=True)
class Layer:
    """Geometry, material and mesh of one problem. SI units."""

    thickness: float
    bonded: bool = True
    young: float = 0.2e6
    poisson: float = 0.45
    body_radius: float = 0.1
    indenter_radius: float = 0.01
    cell: float = 2e-4
    """Size of the elements at the contact, m."""
    fine: float = 8e-3
    """Arc length over which elements have that size, m."""
    width: float = 0.045
    """Arc length of the layer, m; its end is free."""
    penalty: float = 30.0
    """Stiffness of the contact, in E over the cell."""

    @cached_property
    def basis(self) -> skfem.Basis:
        """Displacements of the elements of the layer."""
        s = graded(self.cell, self.fine, self.width)
        z = -graded(self.cell, min(1.5e-3, self.thickness), self.thickness)[::-1]
        mesh = skfem.MeshQuad.init_tensor(s, z)
        arc, depth = mesh.p
        radius = self.body_radius + depth
        angle = arc / self.body_radius
        # the height is written without the difference of large numbers
        height = depth * np.cos(angle) - 2 * self.body_radius * np.sin(angle / 2) ** 2
        mesh = skfem.MeshQuad(np.array([radius * np.sin(angle), height]), mesh.t)
        faces = mesh.boundary_facets()
        depth_of = self._depth(mesh.p[:, mesh.facets[:, faces]].mean(axis=1))
        slack = 1e-2 * self.cell
        top, bottom = faces[depth_of > -slack], faces[depth_of < -self.thickness + slack]
        mesh = mesh.with_boundaries({"top": top, "base": bottom})
        return skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=4)

    def _depth(self, x: Array) -> Array:
        """Height (k,), m, over the undeformed surface of points (2, k), of a body at (0, -R)."""
        above = x[1] + self.body_radius
        return np.asarray(np.hypot(x[0], above) - self.body_radius)

    @cached_property
    def fixed(self) -> np.ndarray:
        """Degrees of freedom that do not move."""
        basis = self.basis
        x = basis.doflocs
        axis = np.flatnonzero((x[0] < 1e-9) & np.isin(np.arange(basis.N), self._components(0)))
        base = basis.get_dofs("base").all() if self.bonded else np.empty(0, dtype=int)
        return np.union1d(axis, base)

    def _components(self, k: int) -> np.ndarray:
        """Degrees of freedom of the displacement along axis k."""
        nodal, facet, interior = (self.basis.dofs.nodal_dofs, self.basis.dofs.facet_dofs,
                                  self.basis.dofs.interior_dofs)  # fmt: skip
        return np.concatenate([nodal[k], facet[k], interior[k]])


def graded(cell: float, fine: float, end: float) -> Array:
    """Nodes from 0 to `end`: cells of one size up to `fine`, then growing by a quarter."""
    nodes = list(np.linspace(0.0, min(fine, end), max(round(min(fine, end) / cell), 1) + 1))
    step = cell
    while nodes[-1] < end - 1e-12:
        step *= 1.25
        nodes.append(nodes[-1] + step if nodes[-1] + 1.6 * step < end else end)
    return np.array(nodes)


@dataclass(frozen=True)
class Points:
    """Quadrature points (e, q) of elements or facets, and what their unknowns do there."""

    dofs: np.ndarray
    """Degrees of freedom (e, b)."""
    weight: Array
    """Undeformed area or volume (e, q), all round the axis."""
    rates: Array
    """Derivatives (e, q, c, b) of c quantities by the degrees of freedom."""

    def at(self, u: Array) -> Array:
        """The quantities (e, q, c) of displacements u (n,), m."""
        return np.einsum("eqcb,eb->eqc", self.rates, u[self.dofs])

    def vector(self, forces: Array, size: int) -> Array:
        """Sums (size,) of the forces (e, q, c) conjugate to the quantities."""
        values = np.einsum("eqcb,eqc,eq->eb", self.rates, forces, self.weight)
        return np.asarray(np.bincount(self.dofs.ravel(), values.ravel(), size), dtype=float)

    def matrix(self, moduli: Array, size: int) -> csr_matrix:
        """Matrix (size, size) of the derivatives (e, q, c, c) of the forces."""
        loaded = np.einsum("eqcd,eqdb,eq->eqcb", moduli, self.rates, self.weight)
        e, q, c, b = loaded.shape
        flat = self.rates.reshape(e, q * c, b)
        values = flat.transpose(0, 2, 1) @ loaded.reshape(e, q * c, b)
        rows = np.broadcast_to(self.dofs[:, :, None], values.shape)
        columns = np.broadcast_to(self.dofs[:, None, :], values.shape)
        entries = (values.ravel(), (rows.ravel(), columns.ravel()))
        return coo_matrix(entries, shape=(size, size)).tocsr()


def volume_points(basis: skfem.Basis) -> Points:
    """Of the displacement gradient: rr, rz, zr, zz, and around the axis."""
    radius = np.asarray(basis.global_coordinates())[0]
    rates = [
        [shape[0].grad[0, 0], shape[0].grad[0, 1], shape[0].grad[1, 0], shape[0].grad[1, 1],
         shape[0][0] / radius]
        for shape in basis.basis
    ]  # fmt: skip
    return _points(basis, radius, rates)


def surface_points(basis: skfem.FacetBasis) -> Points:
    """Of the displacement: r and z."""
    radius = np.asarray(basis.global_coordinates())[0]
    return _points(basis, radius, [list(shape[0]) for shape in basis.basis])


def _points(basis: Any, radius: Array, rates: list[list[Array]]) -> Points:
    array = np.array([[np.broadcast_to(x, radius.shape) for x in row] for row in rates])
    return Points(
        np.asarray(basis.element_dofs).T,
        2 * np.pi * radius * np.asarray(basis.dx),
        np.ascontiguousarray(array.transpose(2, 3, 1, 0)),
    )


def volume_ratio(gradient: Array) -> Array:
    """J (e, q): volumes over the undeformed ones."""
    f = gradient + np.array([1.0, 0.0, 0.0, 1.0, 1.0])
    return np.asarray((f[..., 0] * f[..., 3] - f[..., 1] * f[..., 2]) * f[..., 4])


def neo_hookean(gradient: Array, mu: float, lam: float) -> tuple[Array, Array]:
    """First Piola-Kirchhoff stresses (e, q, 5), Pa, and their derivatives (e, q, 5, 5)."""
    f = gradient + np.array([1.0, 0.0, 0.0, 1.0, 1.0])
    plane, around = f[..., :4].reshape(*f.shape[:2], 2, 2), f[..., 4]
    log = np.log(volume_ratio(gradient))[..., None]
    inverse = np.linalg.inv(plane).swapaxes(-1, -2)
    cofactor = np.concatenate([inverse.reshape(*f.shape[:2], 4), 1 / around[..., None]], axis=2)
    stress = mu * (f - cofactor) + lam * log * cofactor
    moduli = lam * cofactor[..., :, None] * cofactor[..., None, :]
    moduli += mu * np.eye(5)
    shear = (mu - lam * log)[..., None]
    turned = np.einsum("eqil,eqkj->eqijkl", inverse, inverse).reshape(*f.shape[:2], 4, 4)
    moduli[..., :4, :4] += shear * turned
    moduli[..., 4, 4] += shear[..., 0, 0] / around**2
    return stress, moduli


@dataclass(frozen=True)
class Ball:
    """A rigid sphere about (0, height) that presses with a penalty, Pa/m."""

    height: float
    radius: float
    stiffness: float
    pulls: bool = False
    """Whether it holds what leaves it, too: the core under a sliding layer."""

    def pressure(self, x: Array) -> tuple[Array, Array, Array]:
        """Pressures (e, q), outward normals (e, q, 2), distances from the centre of x (e, q, 2)."""
        off = x - np.array([0.0, self.height])
        distance = np.linalg.norm(off, axis=-1)
        overlap = self.radius - distance
        overlap = overlap if self.pulls else np.maximum(overlap, 0.0)
        return self.stiffness * overlap, off / distance[..., None], distance

    def force(self, x: Array) -> tuple[Array, Array]:
        """Forces (e, q, 2) against the displacement, per area, and their derivatives."""
        pressure, normal, distance = self.pressure(x)
        square = normal[..., :, None] * normal[..., None, :]
        active = self.stiffness * (pressure != 0)
        bend = (pressure / distance)[..., None, None] * (np.eye(2) - square)
        return -pressure[..., None] * normal, active[..., None, None] * square - bend


class Press:
    """The layer under an indenter that goes down step by step."""

    def __init__(self, layer: Layer) -> None:
        self.layer, basis = layer, layer.basis
        self.volume = volume_points(basis)
        top, base = (
            skfem.FacetBasis(basis.mesh, basis.elem, facets=name, intorder=4)
            for name in ("top", "base")
        )
        self.top, self.base = surface_points(top), surface_points(base)
        self.top_x, self.base_x = (
            np.asarray(b.global_coordinates()).transpose(1, 2, 0) for b in (top, base)
        )
        self.u = np.zeros(basis.N)
        shear = layer.young / (1 + layer.poisson)
        self.mu, self.lam = shear / 2, shear * layer.poisson / (1 - 2 * layer.poisson)
        self.stiffness = layer.penalty * layer.young / layer.cell

    def indenter(self, depth: float) -> Ball:
        """The indenter at a depth, m, below first touch."""
        r = self.layer.indenter_radius
        return Ball(r - depth, r, self.stiffness)

    def advance(self, depth: float) -> float:
        """Press the indenter to `depth`, m; returns the force, N. Raises RuntimeError."""
        free = np.setdiff1d(np.arange(len(self.u)), self.layer.fixed)
        for _ in range(MAX_ITERATIONS):
            matrix, residual, _ = self._assemble(depth)
            step = splu(matrix[free][:, free].tocsc()).solve(-residual[free])
            self._move(free, step)
            if np.abs(step).max() < TOLERANCE:
                return self._assemble(depth)[2]
        raise RuntimeError(f"Newton's method did not converge at a depth of {depth:g} m")

    def _move(self, free: np.ndarray, step: Array) -> None:
        """Add the part of a step that turns no element inside out, and MAX_MOVE at most."""
        change = np.zeros_like(self.u)
        change[free] = step * min(1.0, MAX_MOVE / np.abs(step).max())
        while volume_ratio(self.volume.at(self.u + change)).min() <= 0.1:
            change /= 2
        self.u = self.u + change

    def _assemble(self, depth: float) -> tuple[csr_matrix, Array, float]:
        """Tangent matrix, residual and contact force, N."""
        layer, n = self.layer, len(self.u)
        stress, moduli = neo_hookean(self.volume.at(self.u), self.mu, self.lam)
        matrix, residual = self.volume.matrix(moduli, n), self.volume.vector(stress, n)
        parts = [(self.top, self.top_x, self.indenter(depth))]
        if not layer.bonded:
            core = layer.body_radius - layer.thickness
            ball = Ball(-layer.body_radius, core, self.stiffness, pulls=True)
            parts.append((self.base, self.base_x, ball))
        for points, x, ball in parts:
            traction, slope = ball.force(x + points.at(self.u))
            matrix = matrix + points.matrix(slope, n)
            residual = residual + points.vector(traction, n)
        traction, _ = self.indenter(depth).force(self.top_x + self.top.at(self.u))
        return matrix, residual, float(np.sum(traction[..., 1] * self.top.weight))

    def pressures(self, depth: float) -> tuple[Array, Array]:
        """Arc lengths (k,), m, of the quadrature points of the skin, and pressures (k,), Pa, there.

        The pressure is normal to the indenter, per undeformed area.
        """
        pressure, _, _ = self.indenter(depth).pressure(self.top_x + self.top.at(self.u))
        radius = self.layer.body_radius
        arc = radius * np.arctan2(self.top_x[..., 0], self.top_x[..., 1] + radius)
        order = np.argsort(arc.ravel())
        return arc.ravel()[order], pressure.ravel()[order]


def indentation(layer: Layer, depths: Array) -> tuple[Array, list[tuple[Array, Array]]]:
    """Forces (d,), N, and pressures over arc length at increasing depths (d,), m."""
    press, forces, found = Press(layer), [], []
    for depth in depths:
        forces.append(press.advance(float(depth)))
        found.append(press.pressures(float(depth)))
    return np.array(forces), found


def tabulated(layer: Layer, step: float = 1e-4, forces: tuple[float, float] = (1.2, 6.2)
              ) -> Tabulated:  # fmt: skip
    """The profile of the pressure over a range of forces, N, by depths that rise by `step`, m."""
    press, depth, rows = Press(layer), 0.0, []
    r = np.arange(0.0, REACH, 5e-5)
    found: list[float] = []
    while not found or found[-1] < forces[1]:
        depth += step
        force = press.advance(depth)
        if force > 0.5 * forces[0]:
            found.append(force)
            rows.append(np.interp(r, *press.pressures(depth)))
    if found[0] > forces[0]:
        raise ValueError(f"the first depth presses with {found[0]:.3g} N: take a smaller step")
    return Tabulated(r, np.array(found), np.array(rows))


@lru_cache(maxsize=8)
def stored(layer: Layer) -> Tabulated:
    """`tabulated`, kept in the user's cache folder: it takes a minute."""
    source = Path(__file__).read_bytes() + repr(layer).encode()
    folder = cache_folder()
    if folder is None:
        return tabulated(layer)
    file = folder / "worlds" / f"{hashlib.sha256(source).hexdigest()[:16]}.npz"
    if not file.exists():
        made = tabulated(layer)
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, r=made.r, force=made.force, pressure=made.pressure)
    with np.load(file) as table:
        return Tabulated(table["r"], table["force"], table["pressure"])
