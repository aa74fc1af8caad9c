"""The layered model: axisymmetric finite elements, limits, derivatives."""

import casadi as ca
import numpy as np
import pytest
from scipy.sparse.linalg import splu

from meshskin import contact
from meshskin.contact import boundary_elements, layered
from meshskin.core.errors import ContactError

CASE = {"force": 1.0, "indenter_radius": 0.01, "modulus": 0.5e6, "poisson": 0.45}


def graded(first, ratio, end, most=np.inf):
    """Points from 0 to `end` whose steps grow from about `first` by `ratio` up to `most`."""
    steps = [first]
    while sum(steps) < end:
        steps.append(min(ratio * steps[-1], most))
    return np.concatenate([[0.0], end * np.cumsum(steps) / sum(steps)])


def by_finite_elements(thickness, poisson, fine=1.0):
    """Force, peak, depth of a rigid paraboloid z = r^2/2 with contact radius 1 on a bonded layer.

    E = 1. Axisymmetric elasticity on quadratic quadrilaterals (scikit-fem), graded to the edge of
    the contact; frictionless. The depth is that at which the pressure at the edge vanishes.
    """
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import grad

    edge, far = 0.002 * fine, 6 * max(thickness, 1.0)
    inner = graded(edge, 1.25, 1.0, most=0.05 * fine)
    r = np.concatenate([1 - inner[::-1], 1 + graded(edge, 1.25, far)[1:]])
    z = -graded(0.01 * fine, 1.22, thickness)[::-1]
    mesh = skfem.MeshQuad.init_tensor(r, z)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=5)
    mu, bulk = 0.5 / (1 + poisson), poisson / ((1 + poisson) * (1 - 2 * poisson))

    @skfem.BilinearForm
    def energy(u, v, w):
        radius, du, dv = w.x[0], grad(u), grad(v)
        a, b = (du[0, 0], u[0] / radius, du[1, 1]), (dv[0, 0], v[0] / radius, dv[1, 1])
        normal = bulk * sum(a) * sum(b) + 2 * mu * sum(s * t for s, t in zip(a, b, strict=True))
        return (normal + mu * (du[0, 1] + du[1, 0]) * (dv[0, 1] + dv[1, 0])) * radius

    stiffness = energy.assemble(basis).tocsc()
    x, y = basis.doflocs
    dofs = basis.get_dofs(elements=True)
    radial = np.isin(np.arange(basis.N), dofs.all(["u^1"]))
    touching = np.flatnonzero(~radial & (y > -1e-12) & (x < 1 + 1e-12))
    touching = touching[np.argsort(x[touching])]
    fixed = (y < -thickness + 1e-12) | (radial & (x < 1e-12))
    fixed[touching] = True
    free = np.flatnonzero(~fixed)
    given = np.zeros((basis.N, 2))  # unit depth, and the paraboloid
    given[touching] = np.stack([-np.ones(len(touching)), x[touching] ** 2 / 2], axis=1)
    given[free] = splu(stiffness[free][:, free]).solve(-(stiffness[free] @ given))
    flat, bowl = -(stiffness[touching] @ given).T
    depth = -bowl[-1] / flat[-1]
    reaction = depth * flat + bowl
    # pressures from the reactions: the mass matrix of the touching nodes
    top = skfem.FacetBasis(mesh, basis.elem, facets=mesh.facets_satisfying(lambda p: p[1] > -1e-12))

    @skfem.BilinearForm
    def mass(u, v, w):
        return u[1] * v[1] * w.x[0]

    weight = mass.assemble(top).tocsc()[touching][:, touching]
    pressure = splu(weight).solve(reaction)
    inner = x[touching] < 0.5
    peak = np.polynomial.Polynomial.fit(x[touching][inner] ** 2, pressure[inner], 4)(0.0)
    return 2 * np.pi * reaction.sum(), peak, depth


def relative_to_hertz(thickness, poisson, fine=1.0):
    """chi, and radius, peak and depth of the finite elements relative to Hertz's."""
    force, peak, depth = by_finite_elements(thickness, poisson, fine)
    a = (0.75 * force * (1 - poisson**2)) ** (1 / 3)
    return a / thickness, np.array([1 / a, peak / (1.5 * force / (np.pi * a**2)), depth / a**2])


@pytest.mark.slow
def test_finite_elements_converge_to_hertz():
    chi, values = relative_to_hertz(200.0, 0.3)
    assert chi < 0.006
    assert values == pytest.approx(1.0, abs=0.01)
    fine = relative_to_hertz(1.0, 0.45, fine=0.5)[1]
    assert relative_to_hertz(1.0, 0.45)[1] == pytest.approx(fine, rel=3e-3)


@pytest.mark.deep
@pytest.mark.parametrize("poisson", [0.3, 0.4, 0.45, 0.49])
@pytest.mark.parametrize(
    "thickness", [pytest.param(12.0, marks=pytest.mark.slow), 2.2, 1.05, 0.6, 0.33]
)
def test_against_finite_elements(thickness, poisson):
    chi, values = relative_to_hertz(thickness, poisson)
    assert 0.08 < chi < 5.5
    found = np.array(layered.BondedLayer(poisson, 1.0).factors(np.array(chi))[:3])
    assert found == pytest.approx(values, rel=5e-3)


def test_thick_layer_tends_to_hertz():
    reference = contact.solve("elliptic", curvature=(60.0, 0.0), **CASE)
    for thickness, limit in ((None, 1e-9), (1e6, 1e-7), (1.0, 5e-3)):
        patch = contact.solve("layered", curvature=(60.0, 0.0), thickness=thickness, **CASE)
        assert patch.semi_axes == pytest.approx(reference.semi_axes, rel=limit)
        assert [patch.peak, patch.depth] == pytest.approx(
            [reference.peak, reference.depth], rel=limit
        )
        assert patch.exponent == pytest.approx(0.5, abs=limit)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49, 0.5])
def test_thinner_is_stiffer(poisson):
    chi = np.linspace(0.0, layered.MAX_CHI, 300)
    radius, peak, depth, aspect = layered.BondedLayer(poisson, 1.0).factors(chi)
    assert np.all(np.diff(peak[1:]) > 0)
    assert np.all(np.diff(depth) < 0)
    assert np.all(np.diff(radius[30:]) < 0)
    assert np.all(np.abs(radius[:30] - 1) < 0.1)
    # a thin compressible layer is a bed of springs: a/b = (B/A)^(1/2), not (B/A)^(2/3)
    assert aspect.min() == pytest.approx(0.77 if poisson < 0.45 else 0.7, abs=0.07)
    exponent = 1.5 * radius**2 * peak - 1
    assert exponent.min() > 0.498
    assert exponent.max() < 1.2


@pytest.mark.parametrize(("poisson", "thickness"), [(0.3, 3e-3), (0.49, 1e-3)])
@pytest.mark.parametrize("pair", [(0.0, 0.0), (20.0, 0.0), (80.0, -20.0)])
def test_against_boundary_elements_on_ellipses(pair, poisson, thickness):
    case = CASE | {"poisson": poisson, "force": 0.1, "curvature": pair, "thickness": thickness}
    patch = contact.solve("layered", **case)
    reference = boundary_elements.solve(contact.ContactProblem(**case), parabolic=True)
    assert patch.semi_axes == pytest.approx(reference.semi_axes, rel=0.02)
    assert [patch.peak, patch.depth] == pytest.approx([reference.peak, reference.depth], rel=0.02)
    xy = np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)) * patch.semi_axes
    disc = float(patch.semi_axes[1]) / 2
    assert np.abs(patch.reading(xy, disc) - reference.reading(xy, disc)).max() < 0.03 * patch.peak


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49, 0.5])
def test_force_is_the_inverse_of_depth(poisson):
    layer, flat = layered.BondedLayer(poisson, 2e-3), np.zeros((60, 2))
    force = np.geomspace(1e-5, 1.0, 60) * 4 / 3 * 1e6 / 0.01 * (9.9 * 2e-3) ** 3
    found = layer.patches(force, flat, 0.01, 1e6)
    assert layer.force(found.depth, flat, 0.01, 1e6) == pytest.approx(force, rel=1e-8)


def test_casadi_equals_numpy_with_finite_derivatives():
    layer, pair = layered.BondedLayer(0.49, 2e-3), [30.0, -20.0]
    f, k, d = ca.SX.sym("f"), ca.SX.sym("k", 2), ca.SX.sym("d")
    reference = ca.Function("p", [f, k], list(layer.patches(f, k, 0.01, 1e6)))
    plain = layer.patches(1.0, np.array(pair), 0.01, 1e6)
    assert [float(v) for v in reference(1.0, pair)] == pytest.approx(list(plain), rel=1e-12)
    y = layer.force(d, k, 0.01, 1e6)
    push = ca.Function("f", [d, k], [y, ca.gradient(y, d), ca.hessian(y, ca.vertcat(d, k))[0]])
    step = 1e-8
    slope = layer.force(np.array([1e-3 + step, 1e-3 - step]), np.array(pair), 0.01, 1e6)
    assert float(push(1e-3, pair)[1]) == pytest.approx((slope[0] - slope[1]) / 2e-8, rel=1e-6)
    for depth in (-1e-3, 0.0, 1e-9, 1e-3, 1.0):
        assert all(np.isfinite(v.full()).all() for v in push(depth, pair))
    assert float(push(-1e-3, pair)[0]) == 0.0


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"thickness": 1e-4}, "a_Hertz/thickness"),
        ({"poisson": -0.2}, "-0.2"),
        ({"curvature": (250.0, 0.0)}, "3.5"),
        ({"modulus": 0.01e6, "thickness": 0.02}, "a/R"),
        ({"thickness": -1e-3}, "thickness"),
    ],
)
def test_contacts_out_of_range_raise(change, names):
    case = {"curvature": 0.0, "thickness": 2e-3, **CASE} | change
    with pytest.raises(ContactError, match="limit") as caught:
        contact.solve("layered", **case)
    assert names in str(caught.value)


def test_batches_outside_the_table_raise():
    with pytest.raises(ContactError, match="too thin"):
        layered.BondedLayer(0.4, 1e-4).patches(np.array([1e-9, 1.0]), np.zeros((2, 2)), 0.01, 1e6)


@pytest.mark.parametrize(("chi", "poisson"), [(10.0, 0.5), (0.37, 0.21), (2.6, 0.478)])
def test_table_is_the_output_of_its_study(script, chi, poisson):
    found = np.array(layered.BondedLayer(poisson, 1.0).factors(np.array(chi)))
    made = script("layer_table").factors(chi, poisson)
    assert found[:3] == pytest.approx(made[:3], rel=2e-3)
    assert found[3] == pytest.approx(made[3], rel=1e-2)
