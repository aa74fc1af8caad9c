"""What the readings show beyond the contact model is estimated by default, and else named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.joint.departures import FittedReadings
from meshskin.estimation.joint.model_departures import contact_score
from meshskin.estimation.joint.pressure import OBSERVED

CONTACTS = 500
OFFSET = np.array([0.3e-3, -0.2e-3, 0.0])
"""World frame, m; every contact's normal is the world's z axis, which hides an offset along it."""


def headings(normals, seed):
    """Rotations (m, 3, 3), world from body, that turn the normals to the z axis, at any spin."""
    spin = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(normals))
    tangent = np.cross(normals, np.roll(normals, 1, axis=1))
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    facing = np.stack([tangent, np.cross(normals, tangent), normals], axis=1)
    return se3.exp_so3(spin[:, None] * [0.0, 0.0, 1.0]) @ facing


@pytest.fixture(scope="module")
def displaced(noisy):
    """A log whose indenter is OFFSET off, and the belief with the headings."""
    rng, skin = np.random.default_rng(0), noisy.skin
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = noisy.body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    made = ms.press(noisy, points, force=rng.uniform(2.5, 3.5, CONTACTS), seed=0)
    turned = headings(made.normals, seed=1)
    # the recorded points are those of an indenter without the offset
    shrunk = 1 + noisy.indenter.radius / np.linalg.norm(made.points, axis=1)
    recorded = made.points - np.einsum("mji,j->mi", turned, OFFSET) / shrunk[:, None]
    belief = replace(noisy.belief(), contact="auto", headings=turned)
    return replace(
        made.with_columns(points=noisy.body.closest(recorded).point), metadata={}
    ), belief


def rms(found, scene):
    return np.sqrt(np.nanmean(np.sum((found.positions - scene.skin.positions) ** 2, axis=1)))


@pytest.mark.deep
def test_an_indenter_offset_is_estimated_by_default(displaced, noisy):
    recording, belief = displaced
    found = calibrate(recording, belief)
    declared = calibrate(recording, replace(belief, contact="hertz", unknown=("indenter_offset",)))
    assert found.verdict.level == declared.verdict.level == "PASS"
    for axis in range(2):
        value, sigma = found.unknowns[f"indenter_offset {'xyz'[axis]}"]
        assert abs(value - OFFSET[axis]) < 4 * sigma < 0.1e-3
    assert rms(found, noisy) < 1.1 * rms(declared, noisy) < 0.03e-3
    # an offset along the normals, which no reading shows, is not in the standard deviation
    assert np.nanmax(np.sqrt(found.covariances[:, 2, 2])) < 0.1e-3


@pytest.mark.deep
def test_readings_late_by_a_part_of_a_frame_at_random_places(noisy):
    """Each contact is pressed 0.08 of its way to the next one: all taxels are displaced towards the
    middle of the contacts, which no reading of theirs shows: by 1.3 mm rms if it stays in them."""
    rng, skin, body = np.random.default_rng(0), noisy.skin, noisy.body
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    pressed = points.copy()
    pressed[:-1] += 0.08 * np.diff(points, axis=0)
    made = ms.press(noisy, pressed, force=rng.uniform(2.5, 3.5, CONTACTS), seed=0)
    made = made.with_columns(points=points, normals=body.closest(points).normal)
    log = replace(made, metadata={})
    found = calibrate(log, replace(noisy.belief(), contact="auto", readings="raw"))
    way = np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
    assert found.unknowns["drag"][0] == pytest.approx(-0.08 * way, rel=0.1)
    assert rms(found, noisy) < 0.04e-3
    assert rms(found, noisy) < 1.25 * np.sqrt(np.nanmean(found.position_sigma**2))
    assert "ahead of the contacts" in found.verdict.reasons[0]


@pytest.mark.deep
def test_it_is_named_where_the_contact_model_is_fixed(displaced):
    recording, belief = displaced
    found = calibrate(recording, replace(belief, contact="hertz"))
    assert found.verdict.level != "PASS"
    assert any("show" in words and "indenter_offset" in words for words in found.verdict.reasons)


@pytest.mark.deep
def test_an_unknown_far_outside_its_prior_is_a_doubt(displaced):
    recording, belief = displaced
    narrow = replace(belief, contact="hertz", unknown=("indenter_offset",))
    found = calibrate(recording, replace(narrow, priors={"indenter_offset": 2e-5}))
    assert found.verdict.level == "DOUBT"
    assert any("standard deviations of its prior" in words for words in found.verdict.reasons)


@pytest.mark.slow
def test_offsets_that_drift_are_named_where_the_contact_model_is_fixed(noisy):
    rng, skin = np.random.default_rng(0), noisy.skin
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = noisy.body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    made = ms.press(noisy, points, force=rng.uniform(2.5, 3.5, CONTACTS), seed=0)
    rate = 0.05 * made.pressure.max() * rng.standard_normal(len(skin))
    taxel = np.searchsorted(skin.ids, made.readings.column("taxel").to_numpy())
    phase = made.reading_contact / CONTACTS - 0.5
    pressure = made.pressure + rate[taxel] * phase
    drifting = replace(made.with_columns(pressure=pressure), metadata={})
    belief = replace(noisy.belief(), contact="hertz", noise_sigma=None)
    assert calibrate(made, belief).verdict.level == "PASS"
    found = calibrate(drifting, belief)
    assert found.verdict.level != "PASS"
    assert any("drift" in words for words in found.verdict.reasons)


def test_readings_without_weight_determine_no_parameter():
    """As where no taxel has converged."""
    none = np.zeros(4)
    fitted = FittedReadings(
        data=None, readings=SimpleNamespace(taxel=np.array([0, 0, 1, 1])), points=np.zeros((2, 3)),
        mu=np.ones(4), offset=none, rate=none, curvature=none, own=np.ones((3, 4)),
        prior=np.zeros(3), tangents=np.zeros((2, 3, 2)),
    )  # fmt: skip
    slope, information = fitted.shared(np.ones((4, 3)))
    assert not slope.any()
    assert not information.any()


@pytest.mark.parametrize(("visible", "offset", "shown"), [(1e3, 1e-3, True), (10.0, 0.1, False)])
def test_an_offset_of_centimetres_is_an_error_of_the_response(visible, offset, shown):
    """Along a direction in which the readings hardly change, as with contacts on one side of a ball
    along its normals; visible: their change, 1/m."""
    rng, count = np.random.default_rng(0), 400
    column = visible * rng.normal(size=(count, 1))

    class OnlyOffset(FittedReadings):
        def _candidates(self):
            yield "indenter_offset", column, np.zeros(3)

    readings = SimpleNamespace(taxel=np.arange(count) % 20, contact=np.arange(count))
    fitted = OnlyOffset(
        data=SimpleNamespace(headway=np.zeros((count, 3)), phase=np.zeros(count)),
        readings=readings, points=np.zeros((20, 3)), mu=np.ones(count), offset=np.zeros(count),
        rate=-offset * column[:, 0], curvature=np.ones(count), own=rng.normal(size=(2, count)),
        prior=np.zeros(2), tangents=np.tile(np.eye(3)[:, :2], (20, 1, 1)),
    )  # fmt: skip
    score, _ = fitted.scores()["indenter_offset"]
    assert score > 15 if shown else score == 0.0


@pytest.mark.parametrize("seed", [0, 3])
def test_a_single_pair_of_readings_in_one_contact_tells_no_errors_of_contacts(seed):
    """As on a skin whose taxels are farther apart than a patch is wide."""
    rng, count = np.random.default_rng(seed), 1000
    jacobian = 3e4 * rng.normal(size=(3, count + 1))
    jacobian[:, -1] *= 1e-9  # the second reading of contact 0 is beside its patch
    ones = np.ones(count + 1)
    readings = SimpleNamespace(
        kind=np.full(count + 1, OBSERVED), weight=ones, precision=ones,
        contact=np.append(np.arange(count), 0),
    )  # fmt: skip
    estimator = SimpleNamespace(
        problem=SimpleNamespace(
            contacts=SimpleNamespace(with_errors=lambda s, errors: None),
            nuisance=lambda z: None,
            parametrization=SimpleNamespace(count=1),
            points=lambda state: None,
        ),
        state=SimpleNamespace(s=None, z=None),
        data=SimpleNamespace(points=np.zeros((count, 3))),
        likelihood=SimpleNamespace(
            readings=readings, derivatives=lambda points, nuisance, contacts: jacobian
        ),
        residuals=lambda: rng.normal(size=count + 1),
    )
    assert abs(contact_score(estimator)) < 1.5
