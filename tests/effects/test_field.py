"""Layer, elliptic patch and disc averaging: effects on the pressure field."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin import effects
from meshskin.core.errors import ContactError
from meshskin.core.se3 import transform
from meshskin.effects.cover_fabric import CoverFabric
from meshskin.effects.disc_averaging import DiscAveraging
from meshskin.effects.elliptic_patch import EllipticPatch
from meshskin.effects.layer import Layer
from meshskin.geometry.region import Cap

REACH = np.linspace(0.0, 6e-3, 40)


@pytest.fixture
def frame(glide):
    """One contact at the bottom of the sphere."""
    return glide(np.zeros(1))


def along(axis):
    """Taxels (40, 4, 4) on the bottom's tangent plane, along world x (0) or y (1)."""
    down = np.diag([1.0, -1.0, -1.0])  # taxel normals point outward
    return transform(down, np.outer(REACH, np.eye(3)[axis]) - [0.0, 0.0, 0.1])


def with_curvature(frame, pair):
    """The frame on a body of other principal curvatures, the larger along world x."""
    return replace(frame, curvature=np.array([pair]), directions=np.array([[1.0, 0.0, 0.0]]))


def solved(context, model, pair, **more):
    """The patch by contact.solve."""
    young = context.reading_model.effective_modulus * (1 - context.poisson**2)
    return ms.contact.solve(
        model,
        force=context.force,
        curvature=pair,
        indenter_radius=context.indenter_radius,
        modulus=young,
        poisson=context.poisson,
        **more,
    )


@pytest.mark.parametrize("thickness", [3e-3, 8e-3, 0.05])
def test_layer_reads_the_pressure_of_its_contact_model(context, frame, thickness):
    read = Layer(thickness).build(context)(context.reading_model)(frame, along(0))[0]
    patch = solved(context, "layered", (10.0, 10.0), thickness=thickness)
    want = patch.reading(np.outer(REACH, [1.0, 0.0]), context.reading_model.disc_radius)
    np.testing.assert_allclose(read, want, atol=2e-4 * patch.peak)


@pytest.mark.deep
def test_peak_grows_as_the_layer_gets_thinner(context, frame):
    middle, plain = along(0)[:1], context.reading_model(frame, along(0)[:1])[0, 0]
    peaks = [
        Layer(t).build(context)(context.reading_model)(frame, middle)[0, 0]
        for t in (0.05, 8e-3, 3e-3)
    ]
    assert plain < peaks[0] < peaks[1] < peaks[2]
    assert Layer(1e3).build(context)(context.reading_model)(frame, middle)[0, 0] == pytest.approx(
        plain, 1e-4
    )
    assert Layer(0.05).bound(context) < Layer(8e-3).bound(context) < Layer(3e-3).bound(context)
    with pytest.raises(ContactError, match="too thin for the table"):
        Layer(1e-4).build(context)


def test_elliptic_patch_reads_the_pressure_of_its_contact_model(context, frame):
    pair = (40.0, -5.0)
    field, patch = (
        EllipticPatch().build(context)(context.reading_model),
        solved(context, "elliptic", pair),
    )
    for axis in (0, 1):  # the patch's own x axis lies along the smaller curvature
        want = patch.reading(
            np.outer(REACH, np.eye(2)[1 - axis]), context.reading_model.disc_radius
        )
        got = field(with_curvature(frame, pair), along(axis))[0]
        np.testing.assert_allclose(got, want, atol=2e-4 * patch.peak)
    circle, ellipse = (
        f(with_curvature(frame, pair), along(0))[0] for f in (context.reading_model, field)
    )
    assert ellipse[-15] < circle[-15]  # shorter than the circle along the larger curvature
    same = field(frame, along(0)) - context.reading_model(frame, along(0))
    assert np.abs(same).max() < 1e-5 * context.peak_pressure
    layered = replace(
        context.reading_model, model=Layer(0.01).build(context)(context.reading_model).model
    )
    assert EllipticPatch().build(context)(layered) == layered


@pytest.mark.slow
def test_ignoring_the_ellipse_shifts_taxels_by_less_than_its_bound():
    """On a body near the limit of the circular model."""
    plain = ms.Scene.load("sphere_noisy")
    body = ms.Body.ellipsoid((0.1, 0.1, 0.115))
    skin = ms.Skin.cover(body, spacing=5e-3, count=19, region=Cap((0.0, -1.0, 0.0)))
    scene = plain.with_(body=body, skin=skin, loop=replace(plain.loop, mode="quasi_static"))
    world = scene.with_(effects=(*scene.effects, EllipticPatch()))
    before, after = (ms.calibrate(ms.simulate(s, 1), scene.belief()) for s in (scene, world))
    shift = np.nanmax(np.linalg.norm(after.positions - before.positions, axis=1))
    assert 1e-6 < shift <= EllipticPatch().bound(scene.context(1))


def test_discs_average_the_hertz_profile(context, frame):
    """A small disc reads the profile; a wide one reads less at the centre and more at the edge."""
    a, peak = context.contact_radius, context.peak_pressure
    point = DiscAveraging(5e-6).build(context)(context.reading_model)(frame, along(0))[0]
    want = peak * np.sqrt(np.maximum(1 - (REACH / a) ** 2, 0.0))
    np.testing.assert_allclose(point, want, atol=1e-4 * peak)
    wide = DiscAveraging(3e-3).build(context)(context.reading_model)(frame, along(0))[0]
    assert wide[0] < context.reading_model(frame, along(0))[0, 0] < point[0]
    assert wide[-10] > point[-10] == 0.0


@pytest.mark.deep
def test_disc_averaging_equals_a_skin_with_that_disc():
    scene = ms.Scene.load("sphere_noisy")
    scene = scene.with_(loop=replace(scene.loop, mode="quasi_static"))
    other = scene.with_(skin=replace(scene.skin, disc_radius=1e-3))
    world = scene.with_(effects=(*scene.effects, DiscAveraging(1e-3)))
    assert ms.simulate(world, 1).readings.equals(ms.simulate(other, 1).readings)


def test_effects_on_the_field_act_together_under_a_cover(context, frame):
    chosen = (CoverFabric(1e-3), DiscAveraging(1e-3), Layer(5e-3))
    pipeline = effects.EffectPipeline.from_effects(chosen, context, context.reading_model)
    model = Layer(5e-3).build(context)(context.reading_model).model
    ideal = replace(context.reading_model, model=model, disc_radius=1e-3)
    want = CoverFabric(1e-3).build(context)(ideal)(frame, along(1))
    np.testing.assert_array_equal(pipeline.field(frame, along(1)), want)
