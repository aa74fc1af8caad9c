"""Hertz closed forms, their range, and `contact.solve`."""

import casadi as ca
import numpy as np
import pytest

from meshskin import contact
from meshskin.contact import hertz
from meshskin.contact.problem import effective_modulus
from meshskin.core.errors import ContactError

CASE = {
    "force": 3.0,
    "curvature": (10.0, 10.0),
    "indenter_radius": 0.01,
    "modulus": 0.2e6,
    "poisson": 0.49,
}


def test_patch_of_the_paper_sphere():
    patch = contact.solve(**CASE)
    assert patch.semi_axes == pytest.approx([4.27e-3, 4.27e-3], rel=2e-3)
    assert patch.depth == pytest.approx(2.0e-3, rel=5e-3)
    assert patch.pressure([[0, 0], [5e-3, 0]]) == pytest.approx([patch.peak, 0.0])


def test_force_of_depth_inverts_depth_of_force():
    e_star = effective_modulus(0.2e6, 0.49, 2e6, 0.3)
    assert 1 / e_star == pytest.approx((1 - 0.49**2) / 0.2e6 + (1 - 0.09) / 2e6)
    radius = hertz.relative_radius(np.array([[10.0, 10.0], [0.0, 0.0]]), 0.01)
    assert radius == pytest.approx([1 / 110, 0.01])
    a = hertz.contact_radius(3.0, radius, e_star)
    assert hertz.force(hertz.depth(a, radius), radius, e_star) == pytest.approx([3.0, 3.0])
    curvature = np.array([[10.0, 10.0], [0.0, 0.0]])
    peak = hertz.patches(3.0, curvature, 0.01, e_star).peak
    assert peak == pytest.approx(3 * 3.0 / (2 * np.pi * a**2))


def test_casadi_equals_numpy_with_finite_derivatives_at_zero_depth():
    d, k = ca.SX.sym("d"), ca.SX.sym("k", 2)
    y = hertz.force(d, hertz.relative_radius(k, 0.01), 0.26e6)
    f = ca.Function("f", [d, k], [y, ca.gradient(y, d)])
    assert float(f(1e-3, [10, 12])[0]) == pytest.approx(
        hertz.force(1e-3, hertz.relative_radius([10, 12], 0.01), 0.26e6)
    )
    for depth in (-1e-3, 0.0):
        value, slope = (float(v) for v in f(depth, [10, 10]))
        assert value == 0.0
        assert np.isfinite(slope)


@pytest.mark.parametrize(
    ("model", "thickness"), [("hertz", None), ("elliptic", None), ("layered", 2e-3)]
)
def test_an_unknown_depth_has_no_force(model, thickness):
    shape = {"curvature": (10.0, 10.0), "indenter_radius": 0.01, "effective_modulus": 0.26e6}
    force = contact.ContactModel(model, 0.49, thickness).force(
        depth=np.array([np.nan, -1e-3, 1e-3]), **shape
    )
    assert np.isnan(force[0])
    assert force[1] == 0.0 < force[2]


def test_relative_radius_needs_both_curvatures():
    with pytest.raises(ContactError, match=r"shape \(3,\)"):
        hertz.relative_radius(np.full(3, 10.0), 0.01)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"force": -1.0}, "got -1 N"),
        ({"force": float("nan")}, "nan"),
        ({"curvature": (20.0, 10.0)}, "ratio 1.091"),
        ({"curvature": -120.0}, "hollow"),
        ({"curvature": (10.0, 10.0, 10.0)}, "two principal curvatures"),
        ({"modulus": 0.02e6}, "a/R"),
        ({"modulus": 0.0}, "modulus"),
        ({"indenter_radius": -0.01}, "-0.01 m"),
        ({"poisson": 0.6}, "0.6"),
        ({"thickness": 0.01}, "a/thickness = 0.427"),
    ],
)
def test_contacts_out_of_range_raise(change, names):
    with pytest.raises(ContactError, match=r"limit|finite") as caught:
        contact.solve(**CASE | change)
    assert names in str(caught.value)
    assert "\n" not in str(caught.value)


def test_accepts_a_thick_layer():
    assert contact.solve(**CASE, thickness=0.1).peak == contact.solve(**CASE).peak
