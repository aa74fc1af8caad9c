"""Readings by all contact models: quadrature of the pressure over the disc."""

import numpy as np
import pytest

from meshskin import Body, contact
from meshskin.contact import ContactModel
from meshskin.contact.reading import ReadingModel, same_sheet

E_STAR, DISC, INDENTER = 4e5, 2e-3, 0.01


def contact_with_taxels(body, where, rng, count=60):
    """One contact of the body, and taxels about it in its tangent plane."""
    hit = body.closest([where])
    across = np.cross(hit.normal, hit.direction)
    xy = rng.uniform(-8e-3, 8e-3, size=(count, 2))
    taxels = hit.point + xy[:, :1] * hit.direction + xy[:, 1:] * across
    return hit, xy, taxels


def readings(hit, taxels, model):
    """Pressures of the taxels in one contact of 3 N."""
    return ReadingModel(model, DISC, INDENTER, E_STAR).pressures(
        hit.point, hit.normal, hit.direction, np.array([3.0]), hit.curvature, taxels
    )[0]


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


def test_largest_difference_of_two_models():
    """Under Hertz a disc of radius s a reads 2 (1 - (1 - s^2)^1.5) / (3 s^2) p_0 at the centre."""
    curvature, force = np.array([[10.0, 10.0], [10.0, 10.0]]), 3.0
    point, disc = (ReadingModel(ContactModel(), s, INDENTER, E_STAR) for s in (1e-6, DISC))
    s = DISC / np.cbrt(0.75 * force / 110 / E_STAR)
    centre = 2 * (1 - (1 - s**2) ** 1.5) / (3 * s**2)
    difference = point.max_difference(disc, force, curvature)
    assert 1 - centre <= difference < 0.25  # larger at the edge, where the profile is steepest
    assert point.max_difference(point, force, curvature) == 0.0
    stiff = ReadingModel(ContactModel(), DISC, INDENTER, 100 * E_STAR)
    assert disc.max_difference(stiff, force, curvature) == 1.0


@pytest.mark.parametrize("model", [ContactModel(), ContactModel("elliptic")])
def test_taxels_are_projected_onto_the_tangent_plane(model):
    rng = np.random.default_rng(4)
    hit, xy, taxels = contact_with_taxels(Body.sphere(0.1), (0.03, 0.02, -0.09), rng)
    lifted = taxels + np.linspace(-1e-3, 1e-3, len(taxels))[:, None] * hit.normal
    near = np.linalg.norm(xy, axis=1) < 4e-3
    flat = readings(hit, taxels[near], model)
    np.testing.assert_allclose(readings(hit, lifted[near], model), flat, atol=1e-9 * flat.max())


def test_a_taxel_a_little_off_the_surface_is_pressed_at_its_centre():
    """Those of a rigid module lie above and below a curved surface; not so another sheet."""
    up = np.array([[0.0, 0.0, 1.0]])
    offset = 1e-3 * np.array([[0, 0, 0.3], [0.2, 0, -0.4], [0, 0, 2.0], [0.5, 0, 3.0]])
    got = same_sheet(offset, np.tile(up, (4, 1)), np.tile(up, (4, 1)))
    assert got.tolist() == [True, True, False, False]
