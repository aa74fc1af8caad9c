"""Predicted pressures, their derivatives, and the cost of censored readings."""

import numpy as np
import pytest
from scipy.special import log_ndtr

from meshskin.contact import Patches
from meshskin.contact.disc import disc_mean
from meshskin.core.errors import CalibrationError, UnknownNameError
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.global_parameters import PRIORS, SIZES, declared_parameters
from meshskin.estimation.data.pairs import near_pairs
from meshskin.estimation.joint.contact_state import Contacts
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.pressure import censored, costs, disc_means
from meshskin.estimation.joint.readings import Readings

EVERY = (
    *("modulus", "gain", "offset", "force_scale", "force_offset", "indenter_offset"),
    *("drag", "friction", "patch_shift"),
)


@pytest.fixture(scope="module")
def case(world):
    """Measurements with every unknown, and pairs of contacts and taxels near each other."""
    headings = np.broadcast_to(np.eye(3), (len(world.points), 3, 3))
    unknown = (*EVERY, "body_offset")
    data = gather(world.record(), world.belief(unknown=unknown, headings=headings))
    contact, taxel = (
        v[::23]
        for v in near_pairs(
            data, world.truth, data.body.closest(world.truth).normal, data.reach() + 1e-3
        )
    )
    return data, contact, taxel


def circular(offset, normals, radius):
    """M (k,), its gradient (k, 3) and its derivative (k,) in ln a, of circular patches."""
    patches = Patches(radius, radius, np.ones_like(radius), 0 * radius, 0.5)
    none = np.zeros((len(radius), 0))
    contacts = Contacts(0 * normals, normals, normals, patches, (), none, None)
    mean, gradient, (by_log_radius,) = disc_means(
        "hertz", offset, np.arange(len(radius)), contacts, 2e-3
    )
    return mean, gradient, by_log_radius


def test_mean_is_that_of_the_disc():
    rng = np.random.default_rng(0)
    d, a = rng.normal(scale=3e-3, size=(300, 3)), rng.uniform(3e-3, 5e-3, 300)
    n = rng.normal(size=(300, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    mean, slope, by_log_radius = circular(d, n, a)
    rho = np.linalg.norm(np.cross(d, n), axis=1) / a
    assert np.allclose(mean, disc_mean(rho, 2e-3 / a), atol=1e-9)
    h = 1e-7
    for k, axis in enumerate(np.eye(3)):
        ahead, behind = (circular(d + s * h * axis, n, a)[0] for s in (1, -1))
        assert np.allclose((ahead - behind) / (2 * h), slope[:, k], atol=1.0)
    wider, narrower = (circular(d, n, a * np.exp(s * 1e-5))[0] for s in (1, -1))
    assert np.allclose((wider - narrower) / 2e-5, by_log_radius, atol=1e-3)


def test_prediction_is_the_world_s_reading(world, case):
    data, contact, taxel = case
    model = Likelihood(data, Readings.none())
    s = np.zeros(len(data.parameters.sigma))
    contacts = LinearizedContacts(data, s).at(s)
    mu, _ = model.predict(contact, world.truth[taxel], np.zeros((len(taxel), 2)), contacts)
    level = world.pressures()[contact, taxel]
    assert (level > 0).sum() > 100
    assert np.abs(mu * data.sigma - level).max() < 5e-6 * data.peaks.max()


@pytest.mark.parametrize("column", range(16))
def test_every_derivative(world, case, column, derivative_holds):
    derivative_holds(world, case, column)


def test_modulus_force_and_gain_have_one_null_direction(world, case):
    data, contact, taxel = case
    model = Likelihood(data, Readings.none())
    s = np.zeros(len(data.parameters.sigma))
    contacts = LinearizedContacts(data, s).at(s)
    _, jacobian = model.predict(contact, world.truth[taxel], np.zeros((len(taxel), 2)), contacts)
    at = {name: 5 + where.start for name, where in data.parameters.columns.items()}
    null = jacobian[at["modulus"]] + jacobian[at["force_scale"]] - jacobian[3]
    assert np.abs(null).max() < 1e-9 * np.abs(jacobian[3]).max()


def test_contacts_move_with_the_indenter_and_the_body(world, case):
    data, _, _ = case
    columns = data.parameters.columns
    s = np.zeros(len(data.parameters.sigma))
    fixed = LinearizedContacts(data, s.copy())
    s[columns["indenter_offset"]] = [2e-4, -1e-4, 1e-4]
    s[columns["body_offset"]] = [1e-4, 2e-4, 0.0, 1e-3, 0.0, 2e-3]
    there = LinearizedContacts(data, s).at(s)
    assert np.linalg.norm(there.points - data.points, axis=1).mean() > 1e-4
    assert np.abs(fixed.at(s).points - there.points).max() < 3e-6
    assert np.allclose(world.body.closest(there.points).distance, 0, atol=1e-12)


def test_invalid_declarations(world):
    with pytest.raises(UnknownNameError, match="did you mean gain"):
        declared_parameters(("gian",), {}, 3.0, 1e5)
    assert len(declared_parameters(tuple(PRIORS), {"gain": 0.1}, 3.0, 1e5).sigma) == sum(
        SIZES.values()
    )
    data = gather(world.record(), world.belief(unknown=("indenter_offset",)))
    with pytest.raises(CalibrationError, match="headings"):
        LinearizedContacts(data, np.zeros(3))


def test_censored_cost_against_scipy():
    u = np.linspace(-30, 40, 200)
    cost, rate, curvature = censored(u)
    log_density = -(u**2) / 2 - np.log(2 * np.pi) / 2
    mills = np.exp(log_density - log_ndtr(-u))
    assert np.allclose(cost, -log_ndtr(-u), rtol=1e-12)
    assert np.allclose(rate, mills, rtol=1e-10, atol=1e-130)
    assert np.allclose(curvature, mills * (mills - u), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [0, 1, -1])
def test_costs_and_their_derivatives(kind):
    mu, h = np.linspace(-6, 6, 50), 1e-5
    kinds = np.full(50, kind, dtype=np.int8)
    level = np.zeros(50)
    cost, rate, curvature = costs(mu, level, kinds)
    ahead, behind = (costs(mu + s * h, level, kinds) for s in (1, -1))
    assert np.allclose((ahead[0] - behind[0]) / (2 * h), rate, atol=1e-6)
    assert np.allclose((ahead[1] - behind[1]) / (2 * h), curvature, atol=1e-6)
    far = cost[0] if kind == 1 else cost[-1]
    assert (far < 1e-8) == (kind != 0)


def test_contacts_that_do_not_move_have_scaled_patches(world):
    data = gather(world.record(), world.belief())
    contacts = LinearizedContacts(data, np.zeros(1)).at(np.log([0.8]))
    assert isinstance(contacts, Contacts)
    softer = gather(world.record(), world.belief(young=0.8 * 0.2e6))
    assert np.allclose(contacts.radii, softer.radii)
    assert np.allclose(contacts.peaks, softer.peaks)
