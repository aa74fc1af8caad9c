"""Patches whose semi-axes have another ratio than the believed model's.

A thin layer on a rigid cylinder, written here with NumPy alone: pressure is stiffness times the
overlap of the indenter with the layer, and a taxel reads its mean over a disc.
"""

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.learned.estimate import with_learned_response
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording

RADIUS, INDENTER, DISC, STIFFNESS, FORCE = 0.03, 0.01, 2e-3, 6e7, 3.0
PITCH = 5e-3
DEPTH = np.sqrt(FORCE * (1 / INDENTER + 1 / (2 * RADIUS)) / (np.pi * STIFFNESS))
LENGTH = np.sqrt(INDENTER**2 - (INDENTER - DEPTH) ** 2)
WIDTH = RADIUS * np.arccos(1 - LENGTH**2 / (2 * RADIUS * (RADIUS + INDENTER - DEPTH)))
RATIO = np.log(LENGTH / WIDTH)
"""Of the overlap's length along the cylinder and its width along the circumference."""


def on_cylinder(arc, height):
    """Points and normals of arc lengths and heights, m."""
    angle = np.asarray(arc) / RADIUS
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    return RADIUS * normal + np.asarray(height)[..., None] * [0.0, 0.0, 1.0], normal


ARC, HEIGHT = (x.ravel() for x in PITCH * np.mgrid[-3:4, -3:4])
TRUTH, NORMALS = on_cylinder(ARC, HEIGHT)


def recording(seed=0, line=4e-3, step=1.5e-3, kept=0.0):
    """Contacts on lines along the circumference, by turns in either direction.

    kept: the part of the last reading that a low-pass filter keeps.
    """
    rng = np.random.default_rng(seed)
    heights, arcs = np.arange(-0.022, 0.0221, line), np.arange(-0.022, 0.0221, step)
    at = np.array([(s, h) for k, h in enumerate(heights) for s in arcs[:: 1 - 2 * (k % 2)]])
    points, normals = on_cylinder(*at.T)
    force = FORCE * np.exp(0.15 * rng.standard_normal(len(at)))
    relative = 1 / INDENTER + 1 / (2 * RADIUS)
    depth = np.sqrt(force * relative / (np.pi * STIFFNESS))
    centre = points + (INDENTER - depth)[:, None] * normals
    k = np.arange(30) + 0.5
    disc = DISC * np.sqrt(k / 30) * np.exp(1j * np.pi * (1 + 5**0.5) * k)
    disc = np.concatenate([disc, -disc])  # its mean is zero
    felt = on_cylinder(ARC[:, None] + disc.real, HEIGHT[:, None] + disc.imag)[0]
    distance = np.linalg.norm(felt - centre[:, None, None], axis=3)
    pressure = STIFFNESS * np.maximum(INDENTER - distance, 0).mean(axis=2)
    for k in range(1, len(at)):
        pressure[k] += kept * (pressure[k - 1] - pressure[k])
    noise = 0.01 * np.median(pressure.max(axis=0))
    pressure += noise * rng.standard_normal(pressure.shape)
    contact, taxel = np.nonzero(pressure > 3 * noise)
    time = 0.02 * np.arange(len(at))
    columns = [np.ascontiguousarray(x) for x in (time, *points.T, *normals.T, force)]
    readings = [time[contact], taxel.astype(np.int32), pressure[contact, taxel]]
    facts = {"taxel_ids": list(range(len(TRUTH))), "disc_radius_m": DISC}
    return Recording(
        pa.table(columns, schema=CONTACT_SCHEMA), pa.table(readings, schema=READING_SCHEMA), facts
    )


def belief(**changes):
    return ms.Belief(
        body=ms.Body.cylinder(RADIUS, 0.2), indenter=ms.Indenter.sphere(INDENTER),
        material=ms.Material(0.3e6, 0.49), taxel_ids=np.arange(len(TRUTH)), disc_radius=DISC,
        contact="learned", **changes,
    )  # fmt: skip


@pytest.fixture(scope="module")
def data():
    return with_learned_response(gather(recording(), belief()), TRUTH)


def test_derivatives_of_the_semi_axes(data):
    contacts = LinearizedContacts(data, np.zeros_like(data.parameters.sigma))
    s = 0.1 * np.random.default_rng(1).standard_normal(len(data.parameters.sigma))
    at = contacts.at(s)
    for name in ("aspect", "exponents", "modulus"):
        step = np.zeros_like(s)
        step[column := data.parameters.columns[name].start] = 1e-6
        plus, minus = contacts.at(s + step).patches, contacts.at(s - step).patches
        for k, axis in enumerate(("first", "second")):
            slope = np.log(getattr(plus, axis) / getattr(minus, axis)) / 2e-6
            np.testing.assert_allclose(at.shape[k][:, column], slope, atol=1e-7)
    area = at.patches.first * at.patches.second
    round_ = contacts.at(
        np.where(np.arange(len(s)) == data.parameters.columns["aspect"].start, 0, s)
    )
    np.testing.assert_allclose(area, round_.patches.first * round_.patches.second, rtol=1e-12)


@pytest.mark.deep
def test_the_ratio_of_the_semi_axes_is_learned(data):
    found = ms.calibrate(recording(), belief())
    model = float(np.median(np.abs(np.log(data.patches.first / data.patches.second))))
    value, sigma, _ = found.parameter_values["aspect"]
    assert abs((1 + value) * model - RATIO) < 4 * sigma * model
    assert value < -4 * sigma  # narrower than Hertz has it
    assert found.verdict.level == "PASS"
    off = np.einsum("nji,nj->ni", found.poses[:, :3, :3], found.positions - TRUTH)[:, :2]
    inverse = np.linalg.inv(found.covariances[:, :2, :2])
    assert np.mean(np.einsum("ni,nij,nj->n", off, inverse, off)) < 2 + 3 * 2 / len(TRUTH) ** 0.5


@pytest.mark.deep
def test_a_low_pass_filter_is_estimated_and_is_no_delay(data):
    made = recording(kept=0.5)
    assert gather(made, belief()).delay == 0
    found = ms.calibrate(made, belief())
    error = np.sqrt(np.mean(np.sum((found.positions - TRUTH) ** 2, axis=1)))
    assert error < 1.6 * 0.026e-3  # the stated deviation without a filter
    assert 0.7 < np.sqrt(np.mean(found.position_sigma**2)) / error < 1.4
    share, constant = (found.parameter_values[f"creep {x}"] for x in ("share", "time constant"))
    assert abs(share[0] - 1) < 4 * share[1]
    assert abs(constant[0] - 0.02 / np.log(2)) < 4 * constant[1]


def late(made, frames):
    """The recording with its readings some frames too late."""
    row = made.reading_contact + frames
    kept = pa.array(row < len(made.time))
    time = pa.array(made.time[np.minimum(row, len(made.time) - 1)])
    return Recording(
        made.contacts, made.readings.set_column(0, "time", time).filter(kept), made.metadata
    )


@pytest.mark.parametrize("frames", [1, pytest.param(2, marks=pytest.mark.deep), 5])
def test_a_delay_is_no_low_pass_filter(frames):
    """What rises from frame to frame is a smaller part of a patch, which comes earlier."""
    assert gather(late(recording(), frames), belief()).delay == frames


@pytest.mark.parametrize(
    ("kept", "step"),
    [(0.5, 2e-3), pytest.param(0.7, 0.75e-3, marks=pytest.mark.deep), (0.9, 1.5e-3)],
)
def test_the_lag_of_a_low_pass_filter_is_no_delay(kept, step):
    assert gather(recording(line=2e-3, step=step, kept=kept), belief()).delay == 0
