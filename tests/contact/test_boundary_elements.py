"""Boundary elements against tamaas, the elliptic closed form and the integral of the layer."""

import mpmath
import numpy as np
import pytest

from meshskin import contact
from meshskin.contact import boundary_elements, influence
from meshskin.core.errors import ContactError

CASE = {"force": 1.0, "indenter_radius": 0.01, "modulus": 1e6, "poisson": 0.45}
PAIRS = [(10.0, 10.0), (60.0, -20.0), (300.0, 0.0)]


@pytest.mark.parametrize("pair", PAIRS)
def test_parabolic_gap_gives_the_ellipse(pair):
    exact = contact.solve("elliptic", curvature=pair, **CASE)
    found = boundary_elements.solve(contact.ContactProblem(curvature=pair, **CASE), parabolic=True)
    assert found.peak == pytest.approx(exact.peak, rel=1e-3)
    assert found.depth == pytest.approx(exact.depth, rel=1e-3)
    assert found.semi_axes == pytest.approx(exact.semi_axes, rel=6e-3)
    assert found.grid.sum() * np.prod(found.spacing) == pytest.approx(1.0, rel=1e-12)
    xy = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 2)) * exact.semi_axes
    assert np.abs(found.reading(xy, 1e-3) - exact.reading(xy, 1e-3)).max() < 0.005 * exact.peak


def by_tamaas(gap, side, force):
    """Pressures (n, n) on a square of `side` by tamaas, without periodic images."""
    tamaas = pytest.importorskip("tamaas")
    tamaas.set_log_level(tamaas.LogLevel.error)
    model = tamaas.ModelFactory.createModel(
        tamaas.model_type.basic_2d, [side, side], list(gap.shape)
    )
    model.E, model.nu = CASE["modulus"], CASE["poisson"]
    tamaas.ModelFactory.registerNonPeriodic(model, "dcfft")
    solver = tamaas.PolonskyKeerRey(model, -gap, 1e-10)
    solver.setIntegralOperator("dcfft")
    solver.solve(force / side**2)
    return np.array(model.traction)


@pytest.mark.deep
@pytest.mark.parametrize("parabolic", [True, False])
@pytest.mark.parametrize("pair", PAIRS[:2])
def test_against_tamaas(pair, parabolic):
    n, exact = 112, contact.solve("elliptic", curvature=pair, **CASE)
    side = 2.3 * exact.semi_axes[0]
    x = ((np.arange(n) + 0.5) / n - 0.5) * side
    gap = boundary_elements.sphere_gap(x[:, None], x[None], tuple(sorted(pair)), 0.01, parabolic)
    theirs = by_tamaas(gap, side, 1.0)
    body = influence.Influence((n, n), (side / n, side / n), 1e6 / (1 - 0.45**2), 0.45)
    ours = boundary_elements.solve_grid(gap, body, 1.0, (side / n) ** 2, tolerance=1e-6)
    assert np.abs(ours.pressure - theirs).max() < 1e-4 * exact.peak
    if parabolic:  # the peak lies half a cell from the centres of the cells
        offset = 1 - np.sum((x[n // 2] / exact.semi_axes) ** 2)
        assert theirs.max() == pytest.approx(exact.peak * np.sqrt(offset), rel=1e-4)
    grid = contact.solve("field", curvature=pair, **CASE) if not parabolic else None
    if grid is not None:
        assert grid.peak == pytest.approx(theirs.max(), rel=2e-3)


@pytest.mark.parametrize("poisson", [-0.3, 0.0, 0.3, 0.49, 0.5])
def test_layer_influence_equals_its_integral(poisson):
    spacing, t = 0.05, 1.0
    layer = influence.Influence((64, 32), (spacing, spacing), 1.0, poisson, t)
    load = np.zeros((64, 32))
    load[0, 0] = 1.0
    found = layer(load)
    kappa = 3 - 4 * poisson

    def factor(z):
        top = 2 * kappa * mpmath.sinh(2 * z) - 4 * z
        return top / (2 * kappa * mpmath.cosh(2 * z) + 4 * z**2 + 1 + kappa**2)

    for i in (6, 20, 50):
        rho = i * spacing / t
        # 1/r is the integral of J_0, so only L - 1, which falls fast, is integrated
        rest = mpmath.quad(
            lambda z, rho=rho: (factor(z) - 1) * mpmath.besselj(0, z * rho), [0, 2, 5, 10, 30]
        )
        point = spacing**2 / np.pi * (1 / rho + float(rest))
        assert found[i, 0] == pytest.approx(point, abs=2e-3 * spacing**2)


def test_layer_factor_has_no_cancellation():
    for poisson in (0.0, 0.3, 0.5):
        for z in (1e-3, 0.1, 1.0, 5.0, 20.0):
            with mpmath.workdps(60):
                k, y = 3 - 4 * mpmath.mpf(poisson), mpmath.mpf(z)
                top = 2 * k * mpmath.sinh(2 * y) - 4 * y
                exact = top / (2 * k * mpmath.cosh(2 * y) + 4 * y**2 + 1 + k**2) - 1
            found = influence.layer_factor(np.float64(z), poisson)
            assert found == pytest.approx(float(exact), rel=1e-12)


def test_thick_layer_equals_the_half_space_and_a_thinner_one_is_stiffer():
    half_space = boundary_elements.solve(
        contact.ContactProblem(curvature=10.0, **CASE), parabolic=True
    )
    a = half_space.semi_axes[0]
    thick = boundary_elements.solve(
        contact.ContactProblem(curvature=10.0, thickness=300 * a, **CASE), parabolic=True
    )
    assert thick.peak == pytest.approx(half_space.peak, rel=1e-3)
    assert thick.depth == pytest.approx(half_space.depth, rel=5e-3)
    layers = (
        contact.ContactProblem(curvature=10.0, thickness=t * a, **CASE) for t in (2, 1, 0.5, 0.2)
    )
    depths = [boundary_elements.solve(layer).depth for layer in layers]
    assert np.all(np.diff(depths) < 0)


def test_two_bumps_share_the_force():
    n, h = 64, 1e-4
    x = (np.arange(n) - (n - 1) / 2) * h
    one = ((x - 1.5e-3) ** 2)[:, None] + x**2
    gap = np.minimum(one, one[::-1]) / 0.01
    body = influence.Influence((n, n), (h, h), 1e6, 0.45)
    found = boundary_elements.solve_grid(gap, body, 0.05, h * h, tolerance=1e-7)
    assert found.pressure.sum() * h * h == pytest.approx(0.05)
    assert found.pressure == pytest.approx(found.pressure[::-1], abs=1e-3 * found.pressure.max())
    displaced = body(found.pressure) + gap - found.approach
    inside = found.pressure > 0
    assert np.abs(displaced[inside]).max() < 1e-4 * found.approach
    assert displaced[~inside].min() > -1e-4 * found.approach


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"thickness": 5e-5}, "thickness/cell"),
        ({"modulus": 2e3}, "indenter radius"),
        ({"curvature": (0.0, -99.95)}, "2000"),
        ({"force": -1.0}, "-1 N"),
    ],
)
def test_contacts_out_of_range_raise(change, names):
    with pytest.raises(ContactError, match="limit") as caught:
        contact.solve("field", **{"curvature": 0.0, **CASE} | change)
    assert names in str(caught.value)


def test_gaps_and_forces_that_are_not_finite_raise():
    body = influence.Influence((4, 4), (1e-3, 1e-3), 1e6, 0.3)
    for gap, force in ((np.full((4, 4), np.nan), 1.0), (np.zeros((4, 4)), 0.0)):
        with pytest.raises(ContactError, match="finite"):
            boundary_elements.solve_grid(gap, body, force, 1e-6)
