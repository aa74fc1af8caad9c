"""Resolution of beliefs by the recording, and invalid beliefs and recordings."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.contact import ContactModel
from meshskin.core.errors import CalibrationError, ConfigError, ContactError, RecordingError
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.resolve_belief import resolve_belief, valid_contacts
from meshskin.recording.recording import Recording

YOUNG = 0.2e6


def belief(world, thickness=None, **changes):
    """What an owner knows who leaves contact model and force to the recording."""
    material = ms.Material(YOUNG, 0.49, thickness)
    indenter = ms.Indenter.sphere(0.01)
    return ms.Belief(world.body, indenter, material, world.ids, contact="auto", **changes)


@pytest.mark.parametrize(
    ("body", "thickness", "name"),
    [
        (ms.Body.sphere(0.1), None, "hertz"),
        (ms.Body.ellipsoid((0.1, 0.04, 0.1)), None, "elliptic"),
        (ms.Body.sphere(0.1), 4e-3, "layered"),
    ],
)
def test_the_first_contact_model_that_holds(world, body, thickness, name):
    model = ContactModel(name, 0.49, thickness)
    seen = type(world)(extent=9e-3, body=body, model=model)
    recording = seen.record()
    found = resolve_belief(belief(seen, thickness), recording)
    assert found.contact == name
    assert found.force_reference == pytest.approx(np.median(seen.force))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("body", "thickness", "name"),
    [
        (ms.Body.sphere(0.1), None, "hertz"),
        pytest.param(ms.Body.ellipsoid((0.1, 0.04, 0.1)), None, "elliptic", marks=pytest.mark.deep),
        pytest.param(ms.Body.sphere(0.1), 4e-3, "layered", marks=pytest.mark.deep),
    ],
)
def test_a_calibration_takes_the_resolved_belief(world, body, thickness, name):
    seen = type(world)(extent=9e-3, body=body, model=ContactModel(name, 0.49, thickness))
    recording = seen.record()
    found = resolve_belief(belief(seen, thickness), recording)
    positions = ms.calibrate(recording, belief(seen, thickness)).positions
    assert np.array_equal(positions, ms.calibrate(recording, found).positions)
    assert np.nanmax(np.linalg.norm(positions - seen.truth, axis=1)) < 1e-6


@pytest.mark.parametrize(
    ("axes", "name"), [((0.1, 0.1, 0.1), "hertz"), ((0.1, 0.08, 0.08), "elliptic")]
)
def test_a_learned_response_has_ovals_where_hertz_holds_but_patches_are_not_round(
    world, axes, name
):
    """Ovals that the mean lacks pass for lags of single taxels (ratio of curvatures 1.04)."""
    seen = type(world)(extent=9e-3, body=ms.Body.ellipsoid(axes), model=ContactModel("elliptic"))
    recording = seen.record()
    assert resolve_belief(belief(seen), recording).contact == "hertz"
    learned = replace(belief(seen), contact="learned")
    assert resolve_belief(learned, recording).contact == name


def test_contacts_in_which_the_model_does_not_hold():
    """As `solve` says one by one, up to a twentieth of them; the widest is refused, with reason."""
    told = replace(ms.Scene.load("sphere").belief(), contact="hertz")
    rng = np.random.default_rng(0)
    force = 3.0 * np.exp(0.1 * rng.normal(size=100))
    curvature = 10.0 + np.sort(0.5 * rng.normal(size=(100, 2)), axis=1)[:, ::-1]
    assert valid_contacts(force, curvature, told).all()
    force[[7, 40]] *= 60.0
    assert np.array_equal(np.flatnonzero(~valid_contacts(force, curvature, told)), [7, 40])
    force[:10] *= 60.0
    with pytest.raises(ContactError, match="too wide") as error:
        valid_contacts(force, curvature, told)
    alone = {"curvature": tuple(curvature[7]), "indenter_radius": told.indenter.radius}
    law = {"modulus": told.material.young, "poisson": told.material.poisson}
    with pytest.raises(ContactError) as own:
        ms.contact.solve("hertz", force=force[7], **alone, **law)
    assert str(error.value) == str(own.value)
    assert len(valid_contacts(np.empty(0), np.empty((0, 2)), told)) == 0


def test_where_no_contact_model_holds(world):
    body = ms.Body.ellipsoid((0.1, 0.04, 0.1))
    seen = type(world)(extent=9e-3, body=body, model=ContactModel("elliptic"))
    soft = replace(belief(seen), material=ms.Material(2e3, 0.49))
    with pytest.raises(ContactError, match="too wide for the contact model elliptic"):
        resolve_belief(soft, seen.record())


@pytest.fixture(scope="module")
def soft(world):
    """A skin that is softer than believed, or pressed harder than contact models reach: the
    world, its recording, the belief, and the calibration."""
    seen = type(world)(extent=9e-3, step=1.5e-3, body=ms.Body.sphere(0.1))
    recording = seen.record(sigma=0.01, threshold=0.03)
    material = ms.Material(0.4 * YOUNG, 0.49)
    told = replace(belief(seen, threshold=0.03 * seen.peak_reference), material=material)
    return seen, recording, told, ms.calibrate(recording, told)


def test_the_response_is_learned_where_no_contact_model_holds(soft):
    seen, recording, told, found = soft
    with pytest.raises(ContactError, match="too wide for the contact model elliptic"):
        gather(recording, told)
    assert found.response is not None
    error = np.linalg.norm(found.positions - seen.truth, axis=1)
    assert np.sqrt(np.mean(error**2)) < 1.25 * np.sqrt(np.mean(found.position_sigma**2)) < 0.05e-3
    assert np.isfinite(ms.calibrate(recording, told, method="centroid").positions).all()
    with pytest.raises(CalibrationError, match=r"trilateration needs .* too wide"):
        ms.calibrate(recording, told, method="trilateration")


@pytest.mark.deep
def test_a_map_whose_response_was_learned_is_confirmed(soft):
    _, recording, told, found = soft
    assert (ms.recalibrate(found, recording, told).states == "confirmed").all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"disc_radius": 0.0},
        {"disc_radius": 0.5},
        {"noise_sigma": -1.0},
        {"threshold": np.nan},
        {"force_reference": 0.0},
    ],
)
def test_a_belief_out_of_range(world, wrong):
    with pytest.raises(ConfigError, match=rf"belief\.{next(iter(wrong))} "):
        belief(world, **wrong)


def test_numbers_of_numpy_are_numbers(world):
    world = type(world)(extent=9e-3, body=ms.Body.sphere(0.1))
    assert belief(world, noise_sigma=np.float32(400.0), threshold=np.int64(3)).threshold == 3


def test_a_taxel_read_twice_in_one_contact(world):
    recording = world.record()
    table = recording.readings
    gather(
        Recording(recording.contacts, table.take(np.arange(len(table))[::-1]), {}), world.belief()
    )
    twice = pa.concat_tables([table, table.slice(7, 2)])
    taxel = recording.reading_taxel[7]
    with pytest.raises(RecordingError, match=rf"taxel {taxel} at .* s, 2 in all; drop the copies"):
        gather(Recording(recording.contacts, twice, {}), world.belief())


def test_negative_forces(world):
    recording = world.record()
    with pytest.raises(CalibrationError, match=r"forces of at most -2\.9.* N.*check its sign"):
        gather(recording.with_columns(force=-recording.force), world.belief())


def test_one_weak_contact_is_not_a_wrong_unit(world):
    """Pressed beside the taxels it reads, it is weak, not in kPa."""
    recording = world.record()
    strong = np.zeros(len(recording.time))
    np.maximum.at(strong, recording.reading_contact, recording.pressure)
    weak = int(np.argmin(np.where(strong > 0, strong, np.inf)))
    rows = pa.array(recording.reading_contact == weak)
    one = Recording(recording.contacts.slice(weak, 1), recording.readings.filter(rows), {})
    with pytest.raises(CalibrationError, match="fewer than three readings"):
        ms.calibrate(one, world.belief())


@pytest.mark.parametrize("name", ["profile", "hysteresis", "drift"])
def test_what_only_a_learned_response_has_cannot_be_unknown_with_a_contact_model(world, name):
    asked = world.belief(contact="hertz", unknown=("modulus", name))
    with pytest.raises(CalibrationError, match=rf'{name} cannot be unknown.*contact="learned"'):
        resolve_belief(asked, world.record())
