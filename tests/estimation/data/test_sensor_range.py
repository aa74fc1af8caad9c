"""What readings alone show of the sensors: those that were lost, and taxels that end."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.sensor_range import MAX_LOST, unanswered_contacts

from ..learned.test_estimate import PEAK, belief, errors, hertz, recording, world

CONTACTS = 500
ENDING = [5, 10, 15, 20, 30]
"""Taxels that several later contacts press."""
BELIEF = belief(threshold=0.03 * PEAK, contact="learned")


@pytest.fixture(scope="module")
def sound():
    return world(hertz, contacts=CONTACTS)


@pytest.fixture(scope="module")
def whole(sound):
    """The calibration of all readings."""
    return calibrate(recording(*sound), BELIEF)


def kept(sound, lost, seed=0):
    """The recording without the readings lost(rng, contact, taxel)."""
    points, force, contact, taxel, pressure = sound
    keep = ~lost(np.random.default_rng(seed), contact, taxel)
    return recording(points, force, contact[keep], taxel[keep], pressure[keep])


def single(rng, contact, taxel):
    return rng.random(len(contact)) < 0.2


def stretches(rng, contact, taxel):
    """A twelfth of the recording, of each taxel for itself."""
    begin = rng.integers(0, CONTACTS, taxel.max() + 1)[taxel]
    return (contact >= begin) & (contact < begin + CONTACTS // 12)


def ends(rng, contact, taxel):
    """ENDING, in the middle of the contacts that each of them answers."""
    middle = np.array([np.median(contact[taxel == k]) for k in range(taxel.max() + 1)])
    return np.isin(taxel, ENDING) & (contact >= middle[taxel])


def test_taxels_that_end_are_named_and_their_later_silences_left_out(sound, whole):
    data = gather(kept(sound, ends), BELIEF)
    assert data.lost == 0.0
    np.testing.assert_array_equal(data.ids[data.ended[:, 0]], ENDING)
    found = calibrate(kept(sound, ends), BELIEF)
    assert found.verdict.level == "PASS"
    off, stated = errors(found)
    assert off < 1.3 * errors(whole)[0]
    assert off == pytest.approx(stated, rel=0.25)
    named = np.flatnonzero(["answers no more after" in words for words in found.faults])
    np.testing.assert_array_equal(named, ENDING)
    assert not gather(recording(*sound), BELIEF).ended.size
    assert not gather(kept(sound, single), BELIEF).ended.size


@pytest.mark.parametrize("lost", [single, pytest.param(stretches, marks=pytest.mark.deep)])
def test_lost_readings_are_no_silences(sound, whole, lost):
    found = calibrate(kept(sound, lost), BELIEF)
    off, stated = errors(found)
    assert off < 1.3 * errors(whole)[0]
    assert off == pytest.approx(stated, rel=0.25)
    assert found.verdict.level == "DOUBT"
    assert "of the readings are missing" in " ".join(found.verdict.reasons)
    assert not any("missing" in words for words in whole.verdict.reasons)


def test_the_fraction_of_lost_readings(sound):
    assert gather(recording(*sound), belief()).lost == 0.0
    assert gather(kept(sound, single), belief()).lost == pytest.approx(0.2, abs=0.03)
    few = kept(sound, lambda rng, contact, taxel: rng.random(len(contact)) < MAX_LOST / 2)
    assert gather(few, belief()).lost == 0.0


@pytest.mark.parametrize(("degrees", "counts"), [(0, True), (10, True), (25, False)])
def test_a_contact_beyond_an_edge_need_not_be_answered(degrees, counts):
    """The taxel that answers the contact beside it may face away."""
    turn = np.radians(degrees)
    data = SimpleNamespace(
        points=np.array([[0.0, 0.0, 0.0], [3e-4, 0.0, 0.0]]),
        normals=np.array([[0.0, 0.0, 1.0], [np.sin(turn), 0.0, np.cos(turn)]]),
        radii=np.full(2, 3e-3), ids=np.array([7]), counts=np.array([1]),
        contact=np.array([0]), taxel=np.array([0]), pressure=np.array([PEAK]),
    )  # fmt: skip
    beside, unanswered = unanswered_contacts(data)
    assert beside.tolist() == [True, counts]
    assert unanswered.tolist() == [False, counts]
