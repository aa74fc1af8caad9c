"""Declared global and nuisance parameters: estimates within their covariances, null directions."""

import numpy as np
import pytest

from meshskin.contact import ContactModel
from meshskin.core import se3
from meshskin.core.errors import UnknownNameError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty.metrics import cramer_rao, nees, nees_band, position_errors
from meshskin.geometry.primitives import Ellipsoid
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording


def record(world, gain=1.0, offset=0.0, force=None, points=None, seed=0, ceiling=np.inf):
    """A recording with gains, offsets (of the peak), other measured forces and contact points."""
    import pyarrow as pa

    rng = np.random.default_rng(seed)
    p = gain * world.pressures() + offset * world.peak_reference
    p += 0.01 * world.peak_reference * rng.normal(size=p.shape)
    p = np.minimum(p, ceiling * world.peak_reference)
    contact, taxel = np.nonzero(p > 0.05 * world.peak_reference)
    time = 0.01 * np.arange(len(world.points))
    points = world.points if points is None else points
    force = world.force if force is None else force
    columns = [time, *points.T, *world.normals.T, force]
    readings = [time[contact], world.ids[taxel].astype(np.int32), p[contact, taxel]]
    return Recording(
        pa.table(columns, schema=CONTACT_SCHEMA), pa.table(readings, schema=READING_SCHEMA), {}
    )


def check(world, recording, belief):
    """The calibration, where its errors keep to the bound and its covariances hold."""
    found = calibrate(recording, belief)
    bound = cramer_rao(recording, belief, world.skin)
    rms = np.sqrt(np.mean(position_errors(found, world.skin) ** 2))
    assert rms < 1.35 * bound.rms
    low, high = nees_band(len(world.truth), 0.9999)
    assert low < nees(found, world.skin).mean() < high
    assert found.fit.good
    return found


def near(found, name, truth, sigmas=4.5):
    value, sigma = found.unknowns[name]
    assert abs(value - truth) < sigmas * sigma
    return sigma


def test_gains_and_offsets(world, tmp_path):
    rng = np.random.default_rng(0)
    gain, offset = np.exp(0.05 * rng.normal(size=37)), 0.02 * rng.normal(size=37)
    unknown = ("modulus", "gain", "offset")
    found = check(world, record(world, gain, offset), world.belief(0.01, 0.05, unknown=unknown))
    for name, truth in (("gain", np.log(gain)), ("offset", offset * world.peak_reference)):
        value, sigma = found.taxel_unknowns[name].T
        assert np.abs((value - truth) / sigma).max() < 5
    near(found, "modulus", 0.0)
    of_the_ball, of_the_points = found.undetermined
    assert "turn" in of_the_ball
    assert "computed on the believed surface" in of_the_points
    found.save(tmp_path / "c")
    again = Calibration.load(tmp_path / "c")
    assert again.unknowns == found.unknowns
    assert np.array_equal(again.taxel_unknowns["gain"], found.taxel_unknowns["gain"])


@pytest.mark.deep
def test_force_scale_and_offset(world):
    scaled = record(world, force=world.force / 1.2)
    assert not calibrate(scaled, world.belief(0.01, 0.05)).fit.good
    found = check(world, scaled, world.belief(0.01, 0.05, unknown=("modulus", "force_scale")))
    assert near(found, "force_scale", np.log(1.2)) < 2e-3
    shifted = record(world, force=world.force - 0.3)
    found = check(world, shifted, world.belief(0.01, 0.05, unknown=("modulus", "force_offset")))
    assert near(found, "force_offset", 0.3) < 5e-3


def test_modulus_force_and_gain_cannot_be_told_apart(world):
    belief = world.belief(0.01, 0.05, unknown=("modulus", "force_scale", "gain"))
    found = check(world, record(world, force=world.force / 1.2), belief)
    words, of_the_ball, _ = found.undetermined
    assert "turn" in of_the_ball
    assert "modulus +1, force_scale +1, gain -1" in words
    assert found.unknowns["force_scale"][1] > 0.02


@pytest.mark.deep
def test_indenter_offset_with_varied_heading(world):
    d = np.array([3e-4, -2e-4, 1e-4])
    turn = np.random.default_rng(3).uniform(-3, 3, len(world.points))
    headings = se3.exp_so3(turn[:, None] * [0, 0, 1.0])
    height = 0.01 - world.a**2 * (10 + 100)
    centre = world.points + height[:, None] * world.normals
    believed = world.body.closest(centre - np.einsum("mji,j->mi", headings, d)).point
    recording = record(world, points=believed)
    assert not calibrate(recording, world.belief(0.01, 0.05)).fit.good
    unknown = ("modulus", "indenter_offset")
    found = check(world, recording, world.belief(0.01, 0.05, unknown=unknown, headings=headings))
    for axis, truth, limit in zip("xyz", d, (3e-6, 3e-6, 6e-5), strict=True):
        assert near(found, f"indenter_offset {axis}", truth) < limit


def test_the_rotation_of_a_sphere_is_undetermined(world):
    belief = world.belief(0.01, 0.05, unknown=("modulus", "body_offset"))
    found = calibrate(record(world), belief)
    assert any("rotation z" in words for words in found.undetermined)
    assert found.unknowns["body_offset rotation z"][1] == pytest.approx(0.05, rel=0.05)
    assert found.fit.good


@pytest.mark.slow
def test_the_pose_of_an_ellipsoid_is_determined(world):
    body = Ellipsoid((0.06, 0.045, 0.1))
    other = type(world)(extent=20e-3, step=1e-3, body=body, model=ContactModel("elliptic"))
    shift, turn = np.array([3e-4, -2e-4, 1e-4]), np.array([4e-3, -3e-3, 2e-3])
    centre = other.points + (0.01 - other.patches.depth)[:, None] * other.normals
    believed = other.body.closest((centre - shift) @ se3.exp_so3(turn)).point
    recording = record(other, points=believed)
    ignored = calibrate(recording, other.belief(0.01, 0.05))
    assert position_errors(ignored, other.skin).mean() > 0.2e-3
    found = calibrate(recording, other.belief(0.01, 0.05, unknown=("modulus", "body_offset")))
    assert found.fit.good
    for axis, truth in zip("xyz", shift, strict=True):
        assert near(found, f"body_offset {axis}", truth) < 1e-3
    for axis, truth in zip("xyz", turn, strict=True):
        assert near(found, f"body_offset rotation {axis}", truth) < 0.04
    assert found.undetermined == ()


def test_nothing_unknown_but_the_taxels(world):
    found = check(world, record(world), world.belief(0.01, 0.05, unknown=()))
    assert found.unknowns == {}
    assert found.modulus == pytest.approx(world.modulus)


@pytest.mark.deep
def test_saturated_readings_are_censored_from_above(world):
    recording = record(world, ceiling=0.6)
    level = 0.6 * world.peak_reference
    found = calibrate(recording, world.belief(0.01, 0.05, saturation=level))
    blind = calibrate(recording, world.belief(0.01, 0.05))  # the end of the range is found
    np.testing.assert_allclose(blind.positions, found.positions, atol=1e-7)
    clean = calibrate(record(world), world.belief(0.01, 0.05))
    errors = [position_errors(c, world.skin).mean() for c in (found, clean)]
    assert errors[0] < 1.5 * errors[1]
    assert found.modulus == pytest.approx(world.modulus, rel=0.01)
    assert found.fit.good


def test_an_unknown_parameter_name(world):
    with pytest.raises(UnknownNameError, match="did you mean modulus"):
        gather(world.record(), world.belief(unknown=("modulos",)))
