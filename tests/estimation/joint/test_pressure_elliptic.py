"""Predicted pressures under elliptic and layered patches, and their derivatives."""

import numpy as np
import pytest

from meshskin.contact import ContactModel, Patches
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.pairs import near_pairs
from meshskin.estimation.joint.contact_state import Contacts
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.patch_derivatives import loaded_patches
from meshskin.estimation.joint.pressure import disc_means
from meshskin.estimation.joint.readings import Readings
from meshskin.geometry.primitives import Ellipsoid

MODELS = {"elliptic": ContactModel("elliptic"), "layered": ContactModel("layered", 0.49, 4e-3)}
UNKNOWN = ("modulus", "gain", "offset", "force_scale", "force_offset", "indenter_offset")
DISC, COUNT = 2e-3, 300


@pytest.fixture(scope="module")
def worlds(world):
    """Taxels on an ellipsoid with relative curvatures up to 1.5 : 1, by contact model."""
    body = Ellipsoid((0.1, 0.04, 0.1))
    return {name: type(world)(extent=12e-3, body=body, model=m) for name, m in MODELS.items()}


@pytest.fixture(scope="module")
def cases(worlds):
    """Measurements with every unknown, and pairs of contacts and taxels near each other."""
    out = {}
    for name, world in worlds.items():
        headings = np.broadcast_to(np.eye(3), (len(world.points), 3, 3))
        belief = world.belief(unknown=(*UNKNOWN, "body_offset"), headings=headings)
        data = gather(world.record(), belief)
        out[name] = (
            data,
            *(
                v[::11]
                for v in near_pairs(
                    data, world.truth, data.body.closest(world.truth).normal, data.reach() + 1e-3
                )
            ),
        )
    return out


def contacts(first, second, exponent, rng):
    """Contacts with random frames and patches of given sizes (k,)."""
    normals, other = rng.normal(size=(2, len(first), 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    along = np.cross(normals, other)
    along /= np.linalg.norm(along, axis=1)[:, None]
    patches = Patches(first, second, np.ones_like(first), 0 * first, exponent)
    return Contacts(0 * normals, normals, along, patches, (), np.zeros((len(first), 0)), None)


@pytest.mark.parametrize("name", MODELS)
def test_kernel_against_the_patch_and_finite_differences(name):
    rng = np.random.default_rng(0)
    a, b = rng.uniform(2e-3, 5e-3, (2, COUNT))
    m = 0.5 if name == "elliptic" else rng.uniform(0.5, 1.0, COUNT)
    d, rows = rng.normal(scale=3e-3, size=(COUNT, 3)), np.arange(COUNT)
    at = contacts(a, b, m, rng)
    mean, slope, shape = disc_means(name, d, rows, at, DISC)
    along, beside = at.directions, np.cross(at.normals, at.directions)
    x, y = (np.einsum("ki,ki->k", d, axis) for axis in (along, beside))
    assert np.allclose(mean, at.patches.reading(x, y, DISC), atol=1e-12)
    assert np.allclose(mean, at.patches.reading(x, y, DISC, nodes=400), atol=1e-3)
    assert ((mean > 1e-3) & (mean < 0.99)).sum() > 100

    def numeric(change, h):
        return (change(h) - change(-h)) / (2 * h)

    for k, axis in enumerate(np.eye(3)):
        found = numeric(
            lambda h, axis=axis: disc_means(name, d + h * axis, rows, at, DISC)[0], 1e-8
        )
        assert np.allclose(found, slope[:, k], atol=0.5)

    def reshaped(la=0.0, lb=0.0, lm=0.0):
        p = at.patches
        p = p._replace(first=p.first * np.exp(la), second=p.second * np.exp(lb))
        p = p._replace(exponent=p.exponent + lm) if lm else p
        other = Contacts(at.points, at.normals, at.directions, p, (), at.log_peak, None)
        return disc_means(name, d, rows, other, DISC)[0]

    ways = (lambda h: reshaped(la=h), lambda h: reshaped(lb=h), lambda h: reshaped(lm=h))
    assert len(shape) == (2 if name == "elliptic" else 3)
    for way, by in zip(ways, shape, strict=False):
        assert np.abs(by).max() > 0.05
        assert np.allclose(numeric(way, 1e-5), by, atol=1e-3)


def test_equal_semi_axes_give_the_circular_mean():
    rng = np.random.default_rng(1)
    a, d = rng.uniform(3e-3, 5e-3, COUNT), rng.normal(scale=3e-3, size=(COUNT, 3))
    at, rows = contacts(a, a, np.full(COUNT, 0.5), rng), np.arange(COUNT)
    mean, slope, (by_log_a,) = disc_means("hertz", d, rows, at, DISC)
    for name in MODELS:
        found = disc_means(name, d, rows, at, DISC)
        assert np.allclose(found[0], mean, atol=1e-4)
        assert np.allclose(found[1], slope, atol=5.0)
        assert np.allclose(found[2][0] + found[2][1], by_log_a, atol=1e-2)


@pytest.mark.parametrize("name", MODELS)
def test_patches_and_derivatives_under_other_force_and_modulus(cases, name):
    data = cases[name][0]
    off = 0.2 * np.sin(np.arange(len(data.force)))
    found, rates = loaded_patches(data, off, -0.3)
    there = data.model.patches(
        force=data.force * np.exp(off),
        curvature=data.curvature,
        indenter_radius=data.belief.indenter.radius,
        effective_modulus=data.modulus * np.exp(-0.3),
    )
    for one, other in zip(found, there, strict=True):
        assert np.allclose(one, other, rtol=1e-11)
    h = 1e-5
    up, down = (loaded_patches(data, off + s * h, -0.3)[0] for s in (1, -1))
    logs = [np.log(getattr(up, k) / getattr(down, k)) / (2 * h) for k in ("first", "second")]
    for found_rate, numeric in zip(rates.shape, logs, strict=False):
        assert np.allclose(np.ravel(found_rate), numeric, atol=1e-8)
    peak = np.log(up.peak / down.peak) / (2 * h)
    assert np.allclose(np.ravel(rates.peak), peak, atol=1e-8)
    if name == "layered":
        assert np.allclose(rates.shape[2][:, 0], (up.exponent - down.exponent) / (2 * h), atol=1e-8)
        assert np.abs(rates.shape[0] - 1 / 3).min() > 0.01


def test_a_layer_without_thickness_is_a_half_space(worlds, cases):
    _, contact, taxel = cases["elliptic"]
    world = worlds["elliptic"]
    means = []
    for name in MODELS:
        belief = world.belief(contact=name)
        thick = gather(world.record(), belief)
        model = Likelihood(thick, Readings.none())
        at = LinearizedContacts(thick, np.zeros(1)).at(np.array([0.2]))
        none = np.zeros((len(taxel), 0))
        means.append(model.predict(contact, world.truth[taxel], none, at))
    assert np.allclose(means[0][0], means[1][0], atol=1e-6 * means[0][0].max())
    assert np.allclose(means[0][1], means[1][1], atol=1e-5 * np.abs(means[0][1]).max())


@pytest.mark.parametrize("name", MODELS)
def test_prediction_is_the_world_s_reading(worlds, cases, name):
    data, contact, taxel = cases[name]
    model = Likelihood(data, Readings.none())
    s = np.zeros(len(data.parameters.sigma))
    at = LinearizedContacts(data, s).at(s)
    mu, _ = model.predict(contact, worlds[name].truth[taxel], np.zeros((len(taxel), 2)), at)
    level = worlds[name].pressures()[contact, taxel]
    assert (level > 0).sum() > 100
    assert np.abs(mu * data.sigma - level).max() < 3e-4 * data.peaks.max()


@pytest.mark.parametrize("column", range(16))
@pytest.mark.parametrize("name", MODELS)
def test_every_derivative(worlds, cases, name, column, derivative_holds):
    derivative_holds(worlds[name], cases[name], column)


@pytest.mark.parametrize("name", MODELS)
def test_moved_contacts_have_the_patches_of_the_new_curvature(worlds, cases, name):
    data = cases[name][0]
    s = np.zeros(len(data.parameters.sigma))
    s[data.parameters.columns["indenter_offset"]] = [0.0, 5e-3, 0.0]
    moved = LinearizedContacts(data, s).data
    hit = worlds[name].body.closest(moved.points)
    assert np.allclose(moved.curvature, hit.curvature)
    there = data.model.patches(
        force=data.force,
        curvature=hit.curvature,
        indenter_radius=data.belief.indenter.radius,
        effective_modulus=data.modulus,
    )
    assert np.allclose(moved.patches.first, there.first)
    assert np.abs(moved.patches.first / data.patches.first - 1).max() > 0.01
