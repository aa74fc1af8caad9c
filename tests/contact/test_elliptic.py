"""The elliptic patch: exact equations, circular limit, range, derivatives."""

import casadi as ca
import mpmath
import numpy as np
import pytest

from meshskin import contact
from meshskin.contact import elliptic, hertz
from meshskin.core.errors import ContactError

CASE = {"force": 1.0, "indenter_radius": 0.01, "modulus": 0.5e6, "poisson": 0.45}
E_STAR = 0.5e6 / (1 - 0.45**2)


def by_johnson(force, curvature, indenter_radius, e_star):
    """a, b, p_0, depth from Johnson eq. 4.26-4.30, in 30 digits: K and E of the eccentricity."""
    with mpmath.workdps(30):
        low, high = (mpmath.mpf(k) + 1 / mpmath.mpf(indenter_radius) for k in sorted(curvature))
        ratio, half = high / low, low / 2

        def equation(aspect):  # a/b
            m = 1 - 1 / aspect**2
            k, e = mpmath.ellipk(m), mpmath.ellipe(m)
            return mpmath.log((aspect**2 * e - k) / (k - e) / ratio)

        guess = ratio ** mpmath.mpf("0.66")
        aspect = mpmath.findroot(equation, (guess * 0.9, guess), tol=1e-22)
        m = 1 - 1 / aspect**2
        k, e = mpmath.ellipk(m), mpmath.ellipe(m)
        # A = p_0 b (K - E) / (E* e^2 a^2), with p_0 = 3 F / (2 pi a b)
        cube = 3 * mpmath.mpf(force) * (k - e) / (2 * mpmath.pi * e_star * m * half)
        a = mpmath.cbrt(cube)
        b = a / aspect
        peak = 3 * force / (2 * mpmath.pi * a * b)
        return [float(v) for v in (a, b, peak, peak * b * k / e_star)]


def by_hertz(force, curvature, indenter_radius, e_star):
    """a, b, p_0, depth of a circle, Johnson eq. 4.22-4.24."""
    radius = 1 / (curvature[0] + 1 / indenter_radius)
    a = np.cbrt(3 * force * radius / (4 * e_star))
    return a, a, 3 * force / (2 * np.pi * a**2), a**2 / radius


@pytest.mark.parametrize("ratio", [1.0001, 1.05, 1.5, 2, 5, 20, 100, 400, 990])
def test_against_the_exact_equations(ratio):
    pair = (100 * ratio - 100, 0.0)
    found = elliptic.patches(1.0, np.array(pair), 0.01, E_STAR)
    a, b, peak, depth = by_johnson(1.0, pair, 0.01, E_STAR)
    assert [found.second, found.first] == pytest.approx([a, b], rel=1e-8)  # second is smaller
    assert [found.peak, found.depth] == pytest.approx([peak, depth], rel=1e-8)
    assert elliptic.force(found.depth, np.array(pair), 0.01, E_STAR) == pytest.approx(1.0, rel=1e-8)


def test_series_equals_the_equations_between_its_nodes():
    log_ratio = np.linspace(0.0, np.log(1000.0), 700)
    pair = np.stack([np.zeros(700), 100 * np.expm1(log_ratio)], axis=1)
    found = elliptic.patches(1.0, pair, 0.01, E_STAR)
    aspect, size, depth = np.array([elliptic.exact_factors(t) for t in log_ratio]).T
    radius = hertz.relative_radius(pair, 0.01)
    circle = hertz.contact_radius(1.0, radius, E_STAR)
    assert np.allclose(np.log(found.first / found.second), log_ratio * aspect, rtol=1e-8, atol=1e-9)
    assert np.allclose(np.sqrt(found.first * found.second), circle * size, rtol=1e-8, atol=0)
    assert np.allclose(found.depth, circle**2 / radius * depth, rtol=1e-8, atol=0)


def test_circular_limit_equals_hertz():
    circle = contact.solve("hertz", curvature=10.0, **CASE)
    same = contact.solve("elliptic", curvature=10.0, **CASE)
    assert same.semi_axes == pytest.approx(circle.semi_axes, rel=1e-12)
    assert [same.peak, same.depth] == pytest.approx([circle.peak, circle.depth], rel=1e-11)
    for step in (1e-3, 1e-6):  # the mean size differs from the circle's by the square of ln(B/A)
        near = contact.solve("elliptic", curvature=(10 + step, 10 - step), **CASE)
        assert near.peak == pytest.approx(circle.peak, rel=10 * (step / 100) ** 2 + 1e-11)


@pytest.mark.parametrize(
    "pair", [(20.0, 5.0), (0.0, 0.0), (10.0, 0.0), (25.0, -25.0), (-5.0, -60.0), (0.0, -90.0)]
)
def test_convex_flat_saddle_and_hollow(pair):
    patch = contact.solve("elliptic", curvature=pair, **CASE | {"force": 0.02})
    a, b, peak, depth = (by_johnson if pair[0] != pair[1] else by_hertz)(0.02, pair, 0.01, E_STAR)
    assert patch.semi_axes == pytest.approx([a, b], rel=1e-8)
    assert [patch.peak, patch.depth] == pytest.approx([peak, depth], rel=1e-8)
    assert patch.semi_axes[0] >= patch.semi_axes[1]
    assert patch.model == "elliptic"


def test_casadi_equals_numpy_with_finite_derivatives():
    d, k = ca.SX.sym("d"), ca.SX.sym("k", 2)
    y = elliptic.force(d, k, 0.01, E_STAR)
    x = ca.vertcat(d, k)
    f = ca.Function("f", [d, k], [y, ca.gradient(y, x), ca.hessian(y, x)[0]])
    for pair in ([10.0, 10.0], [30.0, -20.0]):
        value, gradient, hessian = (v.full() for v in f(1e-3, pair))
        assert value == pytest.approx(elliptic.force(1e-3, np.array(pair), 0.01, E_STAR), rel=1e-14)
        assert np.isfinite(hessian).all()
        step = 1e-3 * np.eye(2)
        change = [
            elliptic.force(1e-3, pair + s, 0.01, E_STAR)
            - elliptic.force(1e-3, pair - s, 0.01, E_STAR)
            for s in step
        ]
        assert gradient[1:, 0] == pytest.approx(np.array(change) / 2e-3, rel=1e-5)
    for depth in (-1e-3, 0.0):
        assert np.isfinite(f(depth, [30.0, -20.0])[1].full()).all()
    whole = ca.Function("g", [k], list(elliptic.patches(1.0, k, 0.01, E_STAR)[:4]))
    plain = elliptic.patches(1.0, np.array([30.0, -20.0]), 0.01, E_STAR)
    assert [float(v) for v in whole([30.0, -20.0])] == pytest.approx(plain[:4], rel=1e-13)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"curvature": (0.0, -99.95)}, "2000"),
        ({"curvature": (0.0, -110.0)}, "hollow"),
        ({"curvature": (float("nan"), 0.0)}, "finite"),
        ({"modulus": 0.01e6}, "a/R"),
        ({"thickness": 0.01}, "a/thickness"),
        ({"poisson": 0.6}, "0.6"),
    ],
)
def test_contacts_out_of_range_raise(change, names):
    case = {"curvature": (40.0, 0.0), **CASE} | change
    with pytest.raises(ContactError, match=r"limit|finite") as caught:
        contact.solve("elliptic", **case)
    assert names in str(caught.value)


def test_batches_out_of_range_raise():
    with pytest.raises(ContactError, match="hollow"):
        elliptic.patches(1.0, np.array([[0.0, 0.0], [0.0, -100.0]]), 0.01, E_STAR)
    with pytest.raises(ContactError, match="too unequal"):
        elliptic.patches(1.0, np.array([[0.0, 0.0], [0.0, -99.95]]), 0.01, E_STAR)
    with pytest.raises(ContactError, match="shape"):
        elliptic.patches(1.0, np.zeros(3), 0.01, E_STAR)
