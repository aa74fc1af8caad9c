"""A robot that strokes the skin of one of its links over an indenter at rest, and its bag.

The robot is that of a URDF file. Each stroke has a posture of its own: the indenter comes down on
the skin, slides over it under a force, and is lifted off. The bag has joint states whose zeros are
off, raw counts with late stamps, and, if asked for, the wrench of a force sensor.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import meshskin as ms
from meshskin.core.se3 import exp_so3, transform

CLOCK = 0.037
"""Time by which the skin's stamps are late, s."""
FORCE, RADIUS, YOUNG = 3.0, 8e-3, 4e5
"""Of a stroke, N, of the indenter, m, and of the skin, Pa."""
SPEED, HEIGHT, RAMP, AIR = 0.04, 0.015, 0.15, 0.9
"""Of the slide, m/s; from which it comes down, m; in which the force rises, s; in the air, s."""
COUNTS, NOISE, GAINS = 180.0, 1.8, 0.1
"""Counts at the peak pressure under FORCE, of noise, and how far gains are apart."""
SHARP = 100.0
"""Curvature, 1/m, from which an edge is not stroked."""
STEP, COARSE = 2e-3, 20
"""Of the motion, s, and steps from one posture that is sought to the next."""


@dataclass(frozen=True)
class StrokingRobot:
    """The world, and what follows from it."""

    robot: ms.Robot
    link: str
    place: tuple[float, float, float]
    """Centre of the indenter, m, in the frame of the root."""
    posture: tuple[float, ...]
    """Joint angles about which the postures lie, rad."""
    about: tuple[float, float, float]
    """Point near the middle of the skin, m, frame of the link."""
    surface: ms.Body | None = None
    """The real body, m, frame of the link; by default that of its mesh."""
    taxels: int = 40
    strokes: int = 40
    length: float = 0.03
    """Of a stroke, m."""
    spread: float = 0.35
    """Standard deviation of the postures, rad."""
    offset: float = np.radians(1.0)
    """Largest error of a joint's zero, rad."""
    unsteady: float = 0.05
    """Amplitude of the force's wave over a stroke, relative to FORCE."""
    beat: float = 3.0
    """Frequency of that wave, Hz."""
    seed: int = 1

    @cached_property
    def chain(self):
        return self.robot.contact_kinematics(self.link, self.place).chain

    @cached_property
    def scene(self):
        """Body, skin, indenter and material; no arm, no effects."""
        body = self.surface or self.robot.body(self.link, open=True)
        every = ms.Skin.cover(body, spacing=6e-3, seed=1)
        about = np.array(self.about)
        facing = every.normals @ body.closest(about[None]).normal[0] > 0
        # the wall of the iCub's forearm is 2 mm thick, and has taxels on its inside, too
        far = np.where(facing, np.linalg.norm(every.positions - about, axis=1), np.inf)
        kept = np.sort(np.argsort(far)[: self.taxels])
        skin = ms.Skin(every.poses[kept], np.arange(len(kept)), every.disc_radius)
        return ms.Scene(
            body=body, skin=skin, indenter=ms.Indenter.sphere(RADIUS),
            material=ms.Material(young=YOUNG), readout=ms.Readout(rate=50, threshold_relative=0.0),
        )  # fmt: skip

    @cached_property
    def offsets(self):
        """What is to be added to the readings of the joints, rad."""
        rng = np.random.default_rng(100 + self.seed)
        return self.offset * rng.choice([-1.0, 1.0], len(self.chain.joint_names))

    @cached_property
    def motion(self):
        """Times (n,), s, true angles (n, k), contact points (n, 3), NaN in air, and forces (n,)."""
        rng, skin = np.random.default_rng(self.seed), self.scene.skin
        angles, points, forces, last = [], [], [], None
        for _ in range(self.strokes):
            stroke = None
            while stroke is None:
                start = skin.positions[rng.integers(len(skin))] + rng.normal(scale=4e-3, size=3)
                stroke = self._stroke(start, rng)
            path, force, touching, centres = stroke
            near = self.posture + rng.normal(scale=self.spread, size=len(self.posture))
            q = self._follow(near, centres)
            if last is not None:
                way = np.linspace(0, 1, round(AIR / STEP))[:, None]
                way = 0.5 - 0.5 * np.cos(np.pi * way)
                air = last + way * (q[0] - last)
                angles.append(air)
                points.append(np.full((len(air), 3), np.nan))
                forces.append(np.zeros(len(air)))
            angles.append(q)
            points.append(np.where(touching[:, None], path, np.nan))
            forces.append(force)
            last = q[-1]
        angles = np.concatenate(angles)
        return STEP * np.arange(len(angles)), angles, np.concatenate(points), np.concatenate(forces)

    def _stroke(self, start, rng):
        """Points (n, 3) on the body, forces (n,), whether in contact (n,), and centres (n, 3)."""
        body, scene = self.scene.body, self.scene
        hit = body.closest(start[None])
        way = np.cross(hit.normal[0], rng.normal(size=3))
        way /= np.linalg.norm(way)
        slide = np.arange(0, self.length, SPEED * STEP)
        line = hit.point + (slide - self.length / 2)[:, None] * way
        line = body.closest(line + 0.02 * hit.normal).point
        down = round(HEIGHT / 0.05 / STEP)
        rise = round(RAMP / STEP)
        ramp = 0.5 - 0.5 * np.cos(np.pi * np.arange(rise) / rise)
        count = len(line)
        phase = 2 * np.pi * self.beat * STEP * np.arange(count) + rng.uniform(0, 6)
        wave = 1 + self.unsteady * np.sin(phase)
        ends = np.zeros(down + rise, int), np.full(rise + down, count - 1)
        rows = np.concatenate([ends[0], np.arange(count), ends[1]])
        lifted, begin = HEIGHT * np.linspace(0, 1, down), ramp * wave[0]
        pressing = begin, wave, ramp[::-1] * wave[-1]
        force = FORCE * np.concatenate([0 * lifted, *pressing, 0 * lifted])
        air = np.concatenate([lifted[::-1], np.zeros(2 * rise + count), lifted])
        hit = body.closest(line[rows])
        if np.abs(hit.curvature).max() > SHARP or np.abs(np.diff(hit.point, axis=0)).max() > 2e-4:
            return None
        depth = np.zeros(len(rows))
        pressed = force > 0
        depth[pressed] = scene.model.patches(
            force=force[pressed],
            curvature=hit.curvature[pressed],
            indenter_radius=RADIUS,
            effective_modulus=scene.material.effective_modulus,
        ).depth
        centres = hit.point + (RADIUS - depth + air)[:, None] * hit.normal
        return hit.point, force, pressed, centres

    def _follow(self, q, centres):
        """Angles (n, k) near q at which the indenter is at `centres` (n, 3) of the link's frame."""
        coarse = np.append(np.arange(0, len(centres), COARSE), len(centres) - 1)
        way = np.empty((len(coarse), len(q)))
        for k, row in enumerate(coarse):
            q = way[k] = self._reached(q[None], centres[row : row + 1])[0]
        rows = np.arange(len(centres))
        return self._reached(np.stack([np.interp(rows, coarse, a) for a in way.T], axis=1), centres)

    def _reached(self, q, centres):
        """Angles (n, k) as near to q (n, k) as Newton's steps leave them, of least norm."""
        held = self.chain.with_tip(transform(np.eye(3), self.place))
        for _ in range(60):
            error = centres - held.poses(q)[:, :3, 3]
            if np.abs(error).max() < 1e-9:
                return q
            slope = held.jacobian(q)[:, :3]
            square = slope @ np.swapaxes(slope, 1, 2) + 1e-9 * np.eye(3)
            step = np.einsum("nij,ni->nj", slope, np.linalg.solve(square, error[..., None])[..., 0])
            q = q + step * min(1.0, 0.3 / np.abs(step).max())
        raise AssertionError("the indenter is out of reach")

    @cached_property
    def recording(self):
        """True contacts and pressures, without noise, in the frames of the skin."""
        _, rows = self.frames
        points, forces = self.motion[2][rows], self.motion[3][rows]
        pressed = forces > 0.02 * FORCE
        return ms.press(self.scene, points[pressed], force=forces[pressed]), pressed

    @cached_property
    def frames(self):
        """True times of the skin's frames, and their rows of the motion."""
        rows = np.arange(2, len(self.motion[0]), 10)
        return self.motion[0][rows], rows

    def wrench(self, weight, rng):
        """Times (m,), s, and wrenches (m, 6), N, of a sensor that is mounted askew in the link: the
        contact's force and the weight, N, of what follows it; torques are not simulated."""
        times, angles, points, forces = (values[::2] for values in self.motion)
        down = -self.chain.poses(angles)[:, :3, 2]  # of the root, in the link
        push, pressed = np.zeros((len(times), 3)), forces > 0
        push[pressed] = -self.scene.body.closest(points[pressed]).normal
        wrench = np.zeros((len(times), 6))
        mounted = exp_so3([0.3, -0.2, 1.0])
        wrench[:, :3] = (weight * down + forces[:, None] * push) @ mounted.T + [1.0, -2.0, 5.0]
        return times, wrench + 0.02 * rng.normal(size=wrench.shape)

    def streams(self, force=False, weight=None):
        """Times and values by topic; force: with that of the contact along z, weight: with that of
        a sensor in the arm that carries it, N."""
        rng = np.random.default_rng(200 + self.seed)
        times, angles, _, forces = self.motion
        joint = slice(0, None, 4)
        frames, _ = self.frames
        truth, pressed = self.recording
        size = len(self.scene.skin)
        levels = np.zeros((len(truth.time), size))
        levels[truth.reading_contact, truth.reading_taxel] = truth.pressure
        levels *= COUNTS / self.scene.patch.peak * np.exp(GAINS * rng.normal(size=size))
        counts = np.zeros((len(frames), size))
        counts[pressed] = levels
        counts = rng.uniform(225, 245, size) + 2 * frames[:, None] / frames[-1] - counts
        counts += NOISE * rng.normal(size=counts.shape)
        read = angles[joint] - self.offsets + 2e-5 * rng.normal(size=angles[joint].shape)
        streams = {
            "/joint_states": (times[joint], read),
            "/skin": (frames + CLOCK, np.clip(np.round(counts), 0, 255).astype(np.float32)),
        }
        if force:
            wrench = np.zeros((len(times[::2]), 6))
            wrench[:, 2] = 5.0 + forces[::2]
            wrench += 0.02 * rng.normal(size=wrench.shape)
            streams["/wrench"] = (times[::2], wrench)
        if weight is not None:
            streams["/wrench"] = self.wrench(weight, rng)
        return streams
