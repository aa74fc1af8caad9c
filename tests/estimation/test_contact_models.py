"""The joint estimate under elliptic and layered patches, also where the belief has another contact
model than the world.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from meshskin.contact import ContactModel
from meshskin.contact.material import Material
from meshskin.core import se3
from meshskin.core.errors import ContactError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.pairs import silent_pairs
from meshskin.estimation.uncertainty.metrics import cramer_rao, nees, nees_band, position_errors
from meshskin.geometry.primitives import Ellipsoid

MODELS = {"elliptic": ContactModel("elliptic"), "layered": ContactModel("layered", 0.49, 4e-3)}
FIRST = ["layered", pytest.param("elliptic", marks=pytest.mark.deep)]
"""That with the more derivatives; the other one with -m slow."""


@pytest.fixture(scope="module")
def worlds(world):
    """Taxels on an ellipsoid with relative curvatures up to 1.5 : 1, by contact model."""
    body = Ellipsoid((0.1, 0.04, 0.1))
    out = {name: type(world)(extent=12e-3, body=body, model=m) for name, m in MODELS.items()}
    for oval in out.values():
        oval.pressures = oval.pressures().copy  # computed once
    return out


def rms(found, world):
    return np.sqrt(np.mean(position_errors(found, world.skin) ** 2))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        ("layered", 6),
        *(pytest.param(name, 20, marks=pytest.mark.slow) for name in MODELS),
    ],
)
def test_reaches_the_bound_with_consistent_covariance(worlds, name, seeds):
    world = worlds[name]
    belief, square, normalized, moduli = world.belief(0.01, 0.05), [], [], []
    bound = cramer_rao(world.record(0.01, 0.05), belief, world.skin)
    for seed in range(seeds):
        found = calibrate(world.record(0.01, 0.05, seed), belief)
        assert found.fit.good
        square.append(rms(found, world) ** 2)
        normalized.append(nees(found, world.skin).mean())
        moduli.append(np.divide(*found.unknowns["modulus"]))
    # each coordinate is chi-square with one degree: the mean square of n scatters by sqrt(1/n)
    n = seeds * len(world.truth)
    assert np.mean(square) < (1 + 3 / np.sqrt(n)) * bound.rms**2
    low, high = nees_band(n, 0.999)
    assert low < np.mean(normalized) < high
    least, most = chi2.ppf([5e-4, 1 - 5e-4], seeds) / seeds
    assert least < np.mean(np.square(moduli)) < most
    assert found.unknowns["modulus"][1] == pytest.approx(bound.modulus_sigma, rel=0.1)


@pytest.mark.parametrize("name", MODELS)
def test_ideal_readings(worlds, name):
    """What is left without noise is the error of the disc mean's sum."""
    world = worlds[name]
    found = calibrate(world.record(), world.belief())
    assert position_errors(found, world.skin).max() < 0.1e-6
    assert found.modulus == pytest.approx(world.modulus, rel=2e-5)


@pytest.mark.deep
@pytest.mark.parametrize("name", FIRST)
def test_a_softer_belief(worlds, name):
    world = worlds[name]
    recording = world.record(0.01, 0.05)
    fixed = calibrate(recording, world.belief(0.01, 0.05, young=0.16e6, unknown=()))
    assert not fixed.fit.good
    found = calibrate(recording, world.belief(0.01, 0.05, young=0.16e6))
    assert found.fit.good
    assert rms(found, world) < 1.2 * cramer_rao(recording, world.belief(0.01, 0.05), world.skin).rms
    assert abs(found.modulus - world.modulus) < 4 * found.modulus_sigma


def half_space(world, **changes):
    """The belief of one who knows of no layer."""
    material = Material(young=world.young, poisson=0.49, thickness=None)
    return world.belief(0.01, 0.05, contact="hertz", material=material, **changes)


@pytest.mark.slow
def test_a_layer_believed_to_be_a_half_space_does_not_fit(world):
    """By the readings of one force where E* is known; of several forces, whatever E* is."""
    for spread, unknown, least in ((0.01, (), 1.3), (0.6, ("modulus",), 1.2)):
        thin = type(world)(extent=15e-3, model=ContactModel("layered", 0.49, 3e-3), spread=spread)
        recording = thin.record(0.01, 0.05, seed=1)
        declared = thin.belief(0.01, 0.05, unknown=unknown)
        bound = cramer_rao(recording, declared, thin.skin)
        mistaken = calibrate(recording, half_space(thin, unknown=unknown))
        assert mistaken.fit.good is False
        assert rms(mistaken, thin) > least * bound.rms
        found = calibrate(recording, declared)
        assert found.fit.good
        assert rms(found, thin) < 1.2 * bound.rms


def test_an_unknown_modulus_absorbs_a_layer_at_one_force(world):
    """Then nothing is seen of the layer but in E*, and the taxels come out right."""
    thin = type(world)(extent=15e-3, model=ContactModel("layered", 0.49, 3e-3))
    recording = thin.record(0.01, 0.05, seed=1)
    bound = cramer_rao(recording, thin.belief(0.01, 0.05), thin.skin)
    mistaken = calibrate(recording, half_space(thin))
    assert rms(mistaken, thin) < 1.2 * bound.rms
    assert mistaken.modulus > 1.5 * thin.modulus


@pytest.mark.slow
def test_indenter_offset(worlds):
    world, d = worlds["elliptic"], np.array([3e-4, -2e-4, 1e-4])
    turn = np.random.default_rng(3).uniform(-3, 3, len(world.points))
    headings = se3.exp_so3(turn[:, None] * [0, 0, 1.0])
    centre = world.points + (0.01 - world.patches.depth)[:, None] * world.normals
    believed = world.body.closest(centre - np.einsum("mji,j->mi", headings, d)).point
    recording = world.record(0.01, 0.05).with_columns(points=believed)
    assert not calibrate(recording, world.belief(0.01, 0.05)).fit.good
    unknown = ("modulus", "indenter_offset")
    belief = world.belief(0.01, 0.05, unknown=unknown, headings=headings)
    found = calibrate(recording, belief)
    assert found.fit.good
    assert rms(found, world) < 1.3 * cramer_rao(recording, belief, world.skin).rms
    for axis, truth in zip("xyz", d, strict=True):
        value, sigma = found.unknowns[f"indenter_offset {axis}"]
        assert abs(value - truth) < 4 * sigma


@pytest.mark.deep
@pytest.mark.parametrize("name", FIRST)
@pytest.mark.parametrize("method", ["posegraph", "posegraph_paper", "three_circles"])
def test_the_paper_s_methods(worlds, name, method):
    world = worlds[name]
    found = calibrate(world.record(0.005, 0.05), world.belief(0.005, 0.05), method)
    error = position_errors(found, world.skin)
    assert np.isfinite(error).all()
    assert error.mean() < 0.2e-3


@pytest.mark.deep
@pytest.mark.parametrize("name", MODELS)
def test_next_contacts_aim_at_the_worst(worlds, name):
    world = worlds[name]
    belief, recording = world.belief(0.01, 0.05), world.record(0.01, 0.05)
    row = int(np.argmin(np.linalg.norm(world.truth - world.truth.mean(axis=0), axis=1)))
    gap = np.linalg.norm(world.points - world.truth[row], axis=1)
    few = np.isin(recording.reading_contact, np.flatnonzero(gap < 4e-3)[::12])
    mine = recording.reading_taxel == world.ids[row]
    table = recording.readings.filter(list(few | ~mine))
    found = calibrate(type(recording)(recording.contacts, table, {}), belief)
    plan = found.next_contacts(2)
    assert (plan.taxel == world.ids[row]).all()
    assert plan.worst[-1] < 0.9 * found.position_sigma[row]
    assert np.abs(world.body.closest(plan.points).distance).max() < 1e-9


@pytest.mark.parametrize("name", MODELS)
def test_silent_pairs_include_all_informative_ones(worlds, name):
    world = worlds[name]
    recording = world.record(0.0, 0.1)
    data = gather(recording, world.belief(0.01, 0.1))
    n = len(world.ids)
    contact, taxel = silent_pairs(
        data, np.arange(n), world.truth, data.body.closest(world.truth).normal, 1.0
    )
    looked = set((contact * n + taxel).tolist())
    pressures = world.pressures() / world.peak_reference
    telling = np.flatnonzero(((pressures > 0.06) & (pressures < 0.1)).ravel())
    assert len(telling) > 20
    assert looked.issuperset(telling.tolist())


@pytest.mark.deep
def test_an_estimate_outside_the_model_is_refused(world):
    """The nominal E* is within the table of layered; the true one, far softer, is not."""
    thin = type(world)(extent=9e-3, model=ContactModel("layered", 0.49, 0.6e-3), young=1e6)
    found = calibrate(thin.record(), thin.belief(young=2e6))
    assert found.modulus == pytest.approx(thin.modulus, rel=5e-3)
    thin = type(world)(extent=9e-3, model=ContactModel("layered", 0.49, 0.45e-3))
    belief = thin.belief(young=3e6)
    belief.material = replace(belief.material, thickness=0.4e-3)
    with pytest.raises(ContactError, match="too thin for the table"):
        calibrate(thin.record(), belief)


def test_contacts_outside_the_model_are_refused(worlds):
    world = worlds["elliptic"]
    with pytest.raises(ContactError, match=r"too unequal for hertz.*elliptic"):
        gather(world.record(), world.belief(contact="hertz"))
    layer = Material(young=world.young, poisson=0.49, thickness=4e-3)
    with pytest.raises(ContactError, match="too thin for the half-space of elliptic"):
        gather(world.record(), world.belief(material=layer))
    layer = replace(layer, thickness=0.2e-3)
    with pytest.raises(ContactError, match="too thin for the table of layered"):
        gather(world.record(), world.belief(contact="layered", material=layer))


def test_a_few_contacts_out_of_the_models_range_are_left_out(sphere):
    """One contact in forty with far too large a force is left out; many are refused."""
    from meshskin import calibrate, press

    rng = np.random.default_rng(8)
    near = sphere.body.closest(sphere.skin.positions[rng.integers(len(sphere.skin), size=400)]
                               + rng.normal(scale=2e-3, size=(400, 3)))  # fmt: skip
    alone = calibrate(press(sphere, near.point[10:], 3.0), sphere.belief())
    pressed = press(sphere, near.point, 3.0)
    recording = pressed.with_columns(force=np.where(np.arange(400) < 10, 40.0, 3.0))
    found = calibrate(recording, sphere.belief())
    assert "without 10 contacts in which the contact model does not hold" in found.factors
    np.testing.assert_allclose(found.positions, alone.positions, atol=1e-8)
    with pytest.raises(ContactError, match="too wide"):
        calibrate(pressed.with_columns(force=np.full(400, 40.0)), sphere.belief())
