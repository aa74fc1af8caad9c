"""Contacts whose readings misfit together: left out where they are few, else the model is wrong."""

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.joint.fault_detection import misfitting_contacts
from meshskin.estimation.joint.outlier_rejection import displaced_contacts, minority
from meshskin.estimation.joint.pressure import OBSERVED
from meshskin.estimation.joint.readings import Readings


def bumps(world, change, every):
    """A recording in which the patch of each `every`-th contact presses harder than believed."""
    recording = world.record(0.01, 0.05)
    bump = recording.reading_contact % every == 1
    return change(recording, pressure=np.where(bump, 1.06, 1.0) * recording.pressure)


@pytest.mark.deep
def test_few_contacts_are_left_out_and_taxels_keep_their_uncertainty(world, change):
    belief = world.belief(0.01, 0.05)
    clean = calibrate(world.record(0.01, 0.05), belief)
    found = calibrate(bumps(world, change, 60), belief)
    assert found.fit.good
    assert any("contacts whose readings fit no others" in factor for factor in found.factors)
    assert np.median(found.position_sigma / clean.position_sigma) == pytest.approx(1.0, abs=0.05)
    error = np.linalg.norm(found.positions - world.truth, axis=1)
    assert np.sqrt(np.mean((error / found.position_sigma) ** 2)) < 1.3
    assert not any(found.faults)


@pytest.mark.deep
def test_many_contacts_are_a_misfit_of_the_model(world, change):
    found = calibrate(bumps(world, change, 4), world.belief(0.01, 0.05))
    assert found.fit.good is False
    assert not any("contacts whose readings" in factor for factor in found.factors)


def test_misfitting_contacts_are_those_that_chance_does_not_explain():
    """100 contacts of two readings: chi-square with two degrees of freedom is beyond u with
    probability exp(-u / 2), so that the limit is at 2 ln 1000 = 13.8."""
    taxel = np.repeat([0, 1], 100)
    readings = Readings(
        contact=np.tile(np.arange(100), 2), taxel=taxel, level=np.ones(200),
        kind=np.zeros(200, dtype=int), source=np.arange(200), weight=np.ones(200),
        precision=np.ones(200), starts=np.array([0, 100, 200]), live=np.arange(2),
    )  # fmt: skip
    r = np.zeros(200)
    r[[7, 107]] = np.sqrt(13.7 / 2)
    r[[8, 108]] = np.sqrt(13.9 / 2) * np.array([1, -1])
    assert misfitting_contacts(readings, r, 1.0).tolist() == [8]
    assert misfitting_contacts(readings, 2 * r, 2.0).tolist() == [8]


def test_contacts_that_are_most_of_what_a_taxel_reads_are_not_outlying():
    taxel = np.repeat([0, 1], 10)
    contact = np.concatenate([np.arange(10), np.arange(5, 15)])
    rows, ones = np.arange(20), np.ones(20)
    readings = Readings(
        contact, taxel, ones, np.full(20, OBSERVED), rows, ones, ones, np.array([0, 10, 20])
    )
    assert minority(np.array([0, 1, 2]), readings).tolist() == [0, 1, 2]
    region = np.arange(8, 15)  # 2 of the 10 that the first taxel reads, 7 of the second's
    assert minority(np.append(region, 0), readings).tolist() == [0]


def test_a_contact_far_off_shows_by_its_displacement_or_its_force():
    """A point that is off may pass for a wrong force: others then seem to have scattered ones."""
    rng, radii, touched = np.random.default_rng(0), np.full(300, 5e-3), np.ones(300, dtype=bool)
    errors = rng.normal(size=(300, 3)) * [1e-5, 1e-5, 0.02]
    touched[250:] = False
    errors[[10, 260], 0], errors[[20, 270], 2], errors[30, 2] = 1e-3, -0.9, 0.3
    assert displaced_contacts(errors, touched, radii).tolist() == [10, 20]
    errors[:100, 2] = 0.9  # no exceptions
    assert not len(displaced_contacts(errors, touched, radii))
