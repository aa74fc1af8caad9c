"""Readings by all contact models: quadrature of the pressure over the disc."""

import numpy as np
import pytest

from meshskin import Body, contact
from meshskin.contact import ContactModel
from meshskin.contact.reading import disc_pressures

E_STAR, DISC, INDENTER = 4e5, 2e-3, 0.01


def contact_with_taxels(body, where, rng, count=60):
    """One contact of the body, and taxels about it in its tangent plane."""
    hit = body.closest([where])
    across = np.cross(hit.normal, hit.direction)
    xy = rng.uniform(-8e-3, 8e-3, size=(count, 2))
    taxels = hit.point + xy[:, :1] * hit.direction + xy[:, 1:] * across
    return hit, xy, taxels


def readings(hit, taxels, model):
    return disc_pressures(
        hit.point, hit.normal, hit.direction, np.array([3.0]), hit.curvature,
        positions=taxels, disc_radius=DISC, indenter_radius=INDENTER,
        effective_modulus=E_STAR, model=model,
    )[0]  # fmt: skip


@pytest.mark.parametrize(
    ("model", "body", "where"),
    [
        (ContactModel("elliptic"), Body.capsule(0.03, 0.2), (0.05, 0.01, 0.03)),
        (ContactModel("elliptic"), Body.torus(0.1, 0.03), (0.06, 0.01, 0.0)),  # a saddle
        (
            ContactModel("layered", 0.45, 4e-3),
            Body.ellipsoid((0.1, 0.07, 0.05)),
            (0.05, 0.05, 0.03),
        ),
    ],
)
def test_reading_is_the_mean_pressure_over_the_disc(model, body, where):
    rng = np.random.default_rng(2)
    hit, xy, taxels = contact_with_taxels(body, where, rng)
    got = readings(hit, taxels, model)
    patch = contact.solve(
        model.name, force=3.0, curvature=tuple(hit.curvature[0]), indenter_radius=INDENTER,
        modulus=E_STAR * (1 - model.poisson**2), poisson=model.poisson, thickness=model.thickness,
    )  # fmt: skip
    # Patch has x along the smaller curvature; an even polar grid over the disc
    radius = DISC * np.sqrt((np.arange(200) + 0.5) / 200)
    angle = 2 * np.pi * (np.arange(400) + 0.5) / 400
    disc = np.stack(
        [np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()], axis=1
    )
    expected = np.array([patch.pressure(p + disc).mean() for p in xy[:, ::-1]])
    assert (expected > 0).sum() > 10
    assert (expected == 0).sum() > 10
    np.testing.assert_allclose(got, expected, atol=1e-4 * patch.peak)
    far = np.linalg.norm(xy, axis=1) > patch.semi_axes[0] + DISC
    assert (got[far] == 0).all()


def test_ellipse_and_thick_layer_equal_hertz_on_a_sphere():
    rng = np.random.default_rng(3)
    hit, _, taxels = contact_with_taxels(Body.sphere(0.1), (0.03, 0.02, -0.09), rng)
    hertz = readings(hit, taxels, ContactModel())
    peak = hertz.max()
    np.testing.assert_allclose(
        readings(hit, taxels, ContactModel("elliptic")), hertz, atol=2e-5 * peak
    )
    thick = ContactModel("layered", 0.49, 10.0)
    np.testing.assert_allclose(readings(hit, taxels, thick), hertz, atol=2e-3 * peak)
