"""Presses: contacts without the closed loop read what the closed loop reads."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ContactError, RecordingError
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.estimation.data.global_parameters import PRIORS
from meshskin.estimation.uncertainty import metrics
from meshskin.simulation import static_contacts
from meshskin.simulation.static_contacts import press


def test_as_the_closed_loop(sphere, recording):
    pressed = press(sphere, recording.points, recording.force)
    assert np.allclose(pressed.points, recording.points, atol=1e-12)
    assert np.allclose(pressed.normals, recording.normals, atol=5e-6)  # the loop's are jets
    dense = np.zeros((2, len(recording.time), int(max(sphere.skin.ids)) + 1))
    for table, found in zip(dense, (pressed, recording), strict=True):
        table[found.reading_contact, found.reading_taxel] = found.pressure
    assert np.abs(dense[0] - dense[1]).max() < 1e-5 * sphere.patch.peak
    assert pressed.metadata["taxel_ids"] == recording.metadata["taxel_ids"]


def test_the_body_stands_on_the_indenter(sphere):
    points = sphere.body.closest(sphere.skin.positions[:4]).point
    pressed = press(sphere, points, spin=[0.0, 0.0, 1.0, -2.0])
    turned, force = pressed.headings, sphere.law.force_reference
    down = np.einsum("kij,kj->ki", turned, pressed.normals)
    assert np.allclose(down, [0, 0, -1], atol=1e-9)
    across = turned[0] @ turned[1].T
    assert np.trace(across) > 2.99  # no spin: the least turn
    assert np.trace(turned[2] @ turned[0].T) == pytest.approx(1 + 2 * np.cos(1.0), abs=0.02)
    assert np.allclose(pressed.force, force)


@pytest.mark.deep
def test_effects_act_and_a_heading_that_varies_shows_the_indenters_offset(sphere):
    offset = (8e-4, -3e-4, 0.0)
    world = sphere.with_(
        effects=(GaussianNoise(0.01), IndenterOffset(offset)),
        readout=ms.Readout(threshold_relative=0.05),
    )
    centre = sphere.skin.positions.mean(axis=0)
    near = np.random.default_rng(0).normal(scale=15e-3, size=(1500, 3))
    recording = press(world, centre + near, spin=np.linspace(-3, 3, 1500), seed=4)
    belief = world.belief(unknown=("modulus", "indenter_offset"))
    found = ms.calibrate(recording, belief)
    apart = 0.1 + sphere.indenter.radius - sphere.patch.depth
    for axis, true in zip("xy", offset, strict=False):
        value, sigma = found.unknowns[f"indenter_offset {axis}"]
        assert value == pytest.approx(-true, abs=4 * sigma)
        # the offset along the believed normal is not seen; the offset itself tilts that normal
        assert sigma < np.hypot(5e-6, PRIORS["indenter_offset"] * abs(true) / apart)
    bound = metrics.cramer_rao(recording, belief, sphere.skin)
    assert np.nanmean(metrics.position_errors(found, sphere.skin)) < 1.2 * bound.mean
    again = press(world, centre + near, spin=np.linspace(-3, 3, 1500), seed=4)
    assert np.array_equal(again.pressure, recording.pressure)


def test_batches_make_no_difference_and_nothing_is_refused(sphere, monkeypatch):
    noisy = sphere.with_(effects=(GaussianNoise(0.01),))
    whole = press(noisy, sphere.skin.positions, seed=2)
    monkeypatch.setattr(static_contacts, "BATCH_CELLS", 7 * len(sphere.skin))
    parts = press(noisy, sphere.skin.positions, seed=2)
    assert parts.readings.equals(whole.readings)
    assert parts.contacts.equals(whole.contacts)
    with pytest.raises(RecordingError, match="no point to press"):
        press(sphere, [])


def test_points_in_other_units_are_refused(sphere):
    with pytest.raises(RecordingError, match=r"median distance 99\.9 m .*, limit: 0.05 m"):
        press(sphere, 1e3 * sphere.skin.positions)


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (-1.0, "got -1 N, limit: above 0 N"),
        ([3.0, np.nan], "must be finite, got nan"),
        (0.0, "got 0 N"),
        ([1.0, 2.0, 3.0], r"one per point, got shape \(3,\), limit: \(2,\)"),
    ],
)
def test_what_is_no_force_is_refused(sphere, force, message):
    with pytest.raises(RecordingError, match=message):
        press(sphere, sphere.skin.positions[:2], force)


def test_what_is_no_spin_is_refused(sphere):
    with pytest.raises(
        RecordingError, match=r"spins of presses .* got shape \(2,\), limit: \(3,\)"
    ):
        press(sphere, sphere.skin.positions[:3], spin=[0.1, 0.2])


def test_contacts_outside_the_range_of_their_model_are_named(sphere):
    points = sphere.skin.positions[:3]
    with pytest.warns(UserWarning, match="hertz contact does not hold in 1 of 3 presses"):
        assert len(press(sphere, points, force=[3.0, 60.0, 2.0]).time) == 3
    with pytest.raises(ContactError):
        press(sphere, points, force=60.0)
