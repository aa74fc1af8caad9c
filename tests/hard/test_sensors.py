"""Sensors and logs at their worst: readings that never change, offsets, polarity, ends of ranges,
frames without contact. Each ends in a right answer or a named one.

19 taxels on a cap of a sphere, read under Hertz' pressure, written here with NumPy alone.
"""

import numpy as np
import pyarrow as pa
import pytest

from meshskin.contact.indenter import Indenter
from meshskin.contact.material import Material
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.sensor_range import ends_of_range
from meshskin.geometry.body import Body
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording
from meshskin.scene.belief import Belief

RADIUS, INDENTER, DISC, FORCE, TAXELS, COUNT = 0.1, 0.01, 5e-4, 3.0, 19, 400
MODULUS = 0.2e6 / (1 - 0.49**2)
A = (3 * FORCE / (1 / RADIUS + 1 / INDENTER) / (4 * MODULUS)) ** (1 / 3)
PEAK = 3 * FORCE / (2 * np.pi * A**2)
NOISE, THRESHOLD = 0.01, 0.05
"""Relative to the peak."""
RIGHT = 1.0e-4
"""Error, m, that a right answer does not exceed: three times that of the sound log."""

PRESSURE_FIRST = ["pressure", pytest.param("raw", marks=pytest.mark.slow)]
"""Kinds of readings; raw ones with -m slow, where both take a second or more."""


def spiral(count, reach):
    """Points (count, 3) on the sphere, m, evenly over a cap of the radius `reach`, m."""
    z = 1 - (reach / RADIUS) ** 2 / 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - z**2)
    return RADIUS * np.column_stack([flat * np.cos(angle), flat * np.sin(angle), z])


TRUTH = spiral(TAXELS, 0.011)
POINTS = spiral(COUNT, 0.016)


def sound(seed=0, part=1.0):
    """Readings (m, n), relative to the peak, of all taxels in all contacts, and the forces (m,):
    `part` (m,) of the usual ones."""
    rng = np.random.default_rng(seed)
    force = FORCE * np.exp(0.05 * rng.standard_normal(COUNT)) * part
    scale = (force / FORCE)[:, None] ** (1 / 3)
    apart = np.linalg.norm(POINTS[:, None] - TRUTH, axis=2) / (A * scale)
    pressure = scale * np.sqrt(np.maximum(1 - apart**2, 0.0))
    return pressure + NOISE * rng.standard_normal(pressure.shape), force


def answer(level, force, dense=False, limit=THRESHOLD, **changes):
    """The calibration of readings (m, n): all of them, or those above the limit."""
    time = 0.01 * np.arange(COUNT)
    contact, taxel = np.nonzero(np.full(level.shape, True) if dense else level > limit)
    log = Recording(
        pa.table([time, *POINTS.T, *(POINTS / RADIUS).T, force], schema=CONTACT_SCHEMA),
        pa.table([time[contact], taxel.astype(np.int32), PEAK * level[contact, taxel]],
                 schema=READING_SCHEMA),
        {"taxel_ids": list(range(TAXELS)), "disc_radius_m": DISC},
    )  # fmt: skip
    belief = Belief(
        body=Body.sphere(radius=RADIUS), indenter=Indenter(INDENTER),
        material=Material(0.2e6, 0.49, None), taxel_ids=np.arange(TAXELS), disc_radius=DISC,
        **changes,
    )  # fmt: skip
    return calibrate(log, belief)


def errors(found):
    """Errors (n,), m."""
    return np.linalg.norm(found.positions - TRUTH, axis=1)


@pytest.mark.deep
@pytest.mark.parametrize("readings", PRESSURE_FIRST)
def test_one_taxel_that_never_changes_is_named_and_harms_no_other(readings):
    level, force = sound()
    level[:, 5] = 0.5
    found = answer(level, force, readings=readings)
    assert np.flatnonzero(np.isnan(errors(found))).tolist() == [5]
    assert np.nanmax(errors(found)) < RIGHT
    assert found.reasons[5] == "its reading never changes"


@pytest.mark.parametrize("readings", ["pressure", "raw"])
def test_readings_that_never_change_are_refused(readings):
    level, force = sound()
    with pytest.raises(CalibrationError, match="the readings never change"):
        answer(0 * level + 0.1 * np.arange(1, TAXELS + 1), force, dense=True, readings=readings)


@pytest.mark.deep
@pytest.mark.parametrize("readings", ["pressure", "raw"])
def test_an_offset_of_all_readings_changes_nothing(readings):
    level, force = sound()
    found = answer(level + 0.3, force, limit=0.3 + THRESHOLD, readings=readings)
    assert errors(found).max() < RIGHT
    assert not any("fall with pressure" in words for words in found.factors)


@pytest.mark.parametrize("falling", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_raw_readings_that_fall_with_pressure_are_turned_and_said(falling):
    level, force = sound()
    found = answer(1.5 - level if falling else level, force, dense=True, readings="raw")
    assert errors(found).max() < RIGHT
    assert any("fall with pressure" in words for words in found.factors) == falling


def test_pressures_that_fall_are_named():
    level, force = sound()
    pressed = np.where(level > THRESHOLD, 1.5 - level, -1.0)
    for log, dense in ((1.5 - level, True), (pressed, False)):
        with pytest.raises(CalibrationError, match="fall where the skin is pressed"):
            answer(log, force, dense=dense)


@pytest.mark.deep
@pytest.mark.parametrize("readings", PRESSURE_FIRST)
def test_the_end_of_one_taxel_s_range_is_found(readings):
    level, force = sound()
    level[:, 5] = np.minimum(level[:, 5], 0.4)
    found = answer(level, force, readings=readings)
    assert errors(found).max() < RIGHT
    assert errors(found)[5] < 4 * found.position_sigma[5]


@pytest.mark.slow
def test_the_end_of_a_common_range_is_found():
    level, force = sound()
    found = answer(np.minimum(level, 0.6), force)
    assert errors(found).max() < RIGHT / 2
    stated = np.sqrt(np.mean(found.position_sigma**2))
    assert np.sqrt(np.mean(errors(found) ** 2)) < 1.5 * stated


def test_ends_of_ranges_by_repeated_largest_readings():
    rng = np.random.default_rng(0)
    smooth, clipped = rng.uniform(0, 1, 60), np.minimum(rng.uniform(0, 1, 60), 0.7)
    flags, counts = np.ones(60), np.round(10 * rng.uniform(0, 1, 60))
    values = np.concatenate([smooth, clipped, flags, counts])
    ends = ends_of_range(values, np.repeat(np.arange(4), 60), 5)
    np.testing.assert_array_equal(ends, [np.inf, 0.7, np.inf, np.inf, np.inf])


@pytest.mark.deep
@pytest.mark.parametrize("readings", PRESSURE_FIRST)
def test_frames_without_contact_are_named_where_they_have_a_force(readings):
    level, force = sound()
    level[1::2] = NOISE * np.random.default_rng(1).standard_normal(level[1::2].shape)
    with pytest.raises(CalibrationError, match="a force where nothing is pressed"):
        answer(level, force, readings=readings)
    force[1::2] = 0.0
    found = answer(level, force, readings=readings)
    assert errors(found).max() < 1.5 * RIGHT
    assert found.verdict.level == "PASS"


@pytest.mark.slow
def test_light_touches_beside_answered_contacts_are_no_fault():
    """Every third contact is that of an approach: a thousandth to a twentieth of the force, whose
    patch a taxel lies beside. With the full force in the log they are frames without contact."""
    light = np.arange(COUNT) % 3 == 0
    level, force = sound(part=np.where(light, np.geomspace(1e-3, 5e-2, COUNT), 1.0))
    found = answer(level, force)
    assert errors(found).max() < RIGHT
    assert found.verdict.level == "PASS"
    with pytest.raises(CalibrationError, match="a force where nothing is pressed"):
        answer(level, np.full(COUNT, FORCE))


@pytest.mark.deep
@pytest.mark.parametrize("readings", PRESSURE_FIRST)
def test_equal_forces_are_answered_with_what_they_leave_open(readings):
    level = sound()[0]
    found = answer(level, np.full(COUNT, FORCE), readings=readings)
    assert errors(found).max() < RIGHT
    assert found.verdict.level == "DOUBT"
    assert any("the force is constant" in words for words in found.verdict.reasons)
