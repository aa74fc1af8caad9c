"""A world: contacts on a cap of taxels, their pressures, and the electronics that record them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import pyarrow as pa
from scipy.interpolate import RectBivariateSpline

from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording

from . import sphere
from .electronics import Electronics, Sensors
from .profiles import FORCES, REACH, Array, Profile
from .sphere import Touch

UNEVEN = 2e-3
"""Length, m, over which the stiffness of an uneven skin is correlated: that of cells of foam."""
STRAY = 3e-3
"""Standard deviation, m, of stray contact points along each tangent."""
Pressures = Callable[[Touch, Array], Array]
"""(contacts, positions (n, 3), m) -> pressures (m, n), Pa, that the taxels feel."""


@dataclass(frozen=True)
class World:
    """How a recording comes about; what the robot's owner does not know."""

    pressures: Pressures
    electronics: Electronics = field(default_factory=Electronics)
    scatter: float = 0.0
    """Standard deviation, m, of the recorded contact points along each tangent."""
    strays: float = 0.0
    """Share of the contacts whose recorded points are `STRAY` off, as of a tracker that loses its
    target."""
    uneven: float = 0.0
    """Standard deviation of ln stiffness of the skin over the body, correlated over `UNEVEN`: a
    contact reads as one of that much more force."""
    force_error: float = 0.0
    """Standard deviation of ln of the recorded over the true force."""
    force_drift: float = 0.0
    """Relative fall of the recorded over the true forces during the recording."""
    skew: float = 0.0
    """Frames from the reading of the first channel to that of the last one; the contact moves on
    between them."""
    order: str = "ids"
    """Order in which the channels are read: by "ids", along the first axis of the "places", or
    "drawn", that of the board's wires."""
    nominal_force: bool = False
    """Whether the recorded force is sphere.FORCE in every contact."""
    dwell: tuple[float, float] = (sphere.FRAME, sphere.FRAME)
    """Least and largest time, s, for which a contact is held until it is read."""
    lift: float = 0.0
    """Time, s, between two contacts in which nothing is touched."""
    guard: int = 0
    """Taxels around the skin that carry load and are not read."""
    taxels: int = 97
    contacts: int = 985


@dataclass(frozen=True)
class Sample:
    """A recording, and apart from it what no calibration may know."""

    recording: Recording
    threshold: float
    """Level that readings had to pass, in their unit."""
    positions: Array
    """True positions (n, 3), m, of the taxels 0 to n - 1."""
    guard: Array
    """Positions (g, 3), m, of the taxels that are not read."""
    touch: Touch
    """True contacts."""
    sensors: Sensors
    dwell: Array
    """Times (m,), s, for which the contacts were held when they were read."""

    def exact(self, world: World, positions: Array | None = None, touch: Touch | None = None
              ) -> Array:  # fmt: skip
        """Readings (m, n) without noise, also at other positions and contacts."""
        at = self.positions if positions is None else positions
        near = np.linalg.norm(self.positions[:, None] - self.positions, axis=2)
        touch, every = touch or self.touch, np.concatenate([at, self.guard])
        if world.skew:
            columns = [
                world.pressures(sphere.advanced(touch, late), every[[k]])[:, 0]
                for k, late in enumerate(self.late(world))
            ]
            pressures = np.stack(columns, axis=1)
        else:
            pressures = world.pressures(touch, every)
        time = self.recording.time
        return self.sensors.exact(pressures[:, : len(at)], near, time, self.dwell)

    def late(self, world: World) -> Array:
        """Frames (n + g,) after which each taxel is read."""
        every = np.concatenate([self.positions, self.guard])
        places = np.argsort(np.argsort(every[:, 0]))
        drawn = np.random.default_rng(len(every)).permutation(len(every))
        rank = {"ids": np.arange(len(every)), "places": places, "drawn": drawn}[world.order]
        return np.asarray(np.linspace(0.0, world.skew, len(every))[rank])


def record(world: World, seed: int) -> Sample:
    """The recording of one seed: positions, forces, noise and faults are drawn from it."""
    every = sphere.taxels(world.taxels + world.guard, seed)
    positions, guard = np.split(every, [world.taxels])
    touch = sphere.spiral(world.contacts, positions, seed)
    sensors = Sensors(world.electronics, peak(world.pressures), world.taxels, seed)
    stray = np.random.default_rng([seed, 11]).random(world.contacts) < world.strays
    measured = sphere.scattered(touch, np.where(stray, STRAY, world.scatter), seed)
    rng = np.random.default_rng([seed, 7])
    force = touch.force * np.exp(world.force_error * rng.normal(size=world.contacts))
    stiffness = np.exp(world.uneven * sphere.stiffness(touch.points, UNEVEN, seed))
    force *= 1 + world.force_drift * np.linspace(0.5, -0.5, world.contacts)
    touch = replace(touch, force=touch.force * stiffness)
    if world.nominal_force:
        force = np.full(world.contacts, sphere.FORCE)
    dwell = np.random.default_rng([seed, 8]).uniform(*world.dwell, world.contacts)
    time = np.cumsum(dwell + world.lift)
    draft = Sample(
        _table(measured, force, time - time[0]), 0.0, positions, guard, touch, sensors, dwell
    )
    reading, threshold = sensors.recorded(draft.exact(world))
    recording = _with_readings(draft.recording, reading, threshold)
    return replace(draft, recording=recording, threshold=threshold)


@lru_cache(maxsize=64)
def peak(pressures: Pressures) -> float:
    """Pressure, Pa, of a taxel in the middle of a contact at the mean force."""
    pole = sphere.RADIUS * np.array([[0.0, 0.0, 1.0]])
    return float(pressures(Touch(pole, np.array([sphere.FORCE])), pole)[0, 0])


def _table(touch: Touch, force: Array, time: Array) -> Recording:
    columns = [time, *touch.points.T, *touch.normals.T, force]
    contacts = pa.table([np.ascontiguousarray(c) for c in columns], schema=CONTACT_SCHEMA)
    return Recording(contacts, READING_SCHEMA.empty_table(), {})


def _with_readings(recording: Recording, reading: Array, threshold: float) -> Recording:
    """The recording with the readings (m, n) above the threshold."""
    contact, taxel = np.nonzero(reading > threshold)
    columns = [recording.time[contact], taxel.astype(np.int32), reading[contact, taxel]]
    metadata = {"taxel_ids": list(range(reading.shape[1])), "disc_radius_m": sphere.DISC_RADIUS}
    return Recording(recording.contacts, pa.table(columns, schema=READING_SCHEMA), metadata)


@dataclass(frozen=True)
class Radial:
    """Pressures that depend on the distance from the contact point and on the force alone."""

    profile: Profile

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Means (m, n), Pa, of the pressure over the taxels' discs."""
        distance = sphere.distances(touch, positions)
        pressure, near = np.zeros_like(distance), distance < REACH
        force = np.broadcast_to(touch.force[:, None], near.shape)[near]
        value = disc_means(self.profile).ev(np.log(force), distance[near])
        pressure[near] = np.maximum(value, 0.0)
        return pressure


@lru_cache(maxsize=64)
def disc_means(profile: Profile) -> RectBivariateSpline:
    """Mean pressure, Pa, over a disc as a spline of (ln force, distance of its centre, m).

    The nodes are a product rule over the radius squared and half a turn: the other half mirrors it,
    so that no node pattern shifts the profile.
    """
    node, weight = np.polynomial.legendre.leggauss(24)
    radius = sphere.DISC_RADIUS * np.sqrt((node + 1) / 2)
    angle = np.pi * (np.arange(32) + 0.5) / 32
    rho = np.arange(0.0, REACH + 2e-4, 1e-4)
    shape = (len(rho), len(radius), len(angle))
    square = rho[:, None, None] ** 2 + radius[:, None] ** 2
    square = square + 2 * rho[:, None, None] * radius[:, None] * np.cos(angle)
    means = [
        (profile(np.sqrt(square), np.full(shape, force)).mean(axis=2) * weight / 2).sum(axis=1)
        for force in FORCES
    ]
    return RectBivariateSpline(np.log(FORCES), rho, np.array(means), kx=3, ky=3, s=0)
