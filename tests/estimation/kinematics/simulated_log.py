"""A log of an arm that slides its skin over a fixed indenter: joint angles and raw counts."""

from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import numpy as np

import meshskin as ms
from meshskin.core.se3 import exp_so3, inverse, transform
from meshskin.exploration.path import Path
from meshskin.exploration.plan import plan_exploration
from meshskin.recording.recording import Recording
from meshskin.recording.skin_log import SkinLog
from meshskin.robot.contact_kinematics import JointPath
from meshskin.simulation.contact_samplers import concatenate
from meshskin.simulation.static_contacts import press_path, without_arm

PUMA = FilePath(__file__).parents[3] / "bodies" / "puma560.urdf"
OFFSETS = np.radians([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
"""Offsets of the six joints: the true angle less the one that is read."""
CLOCK = 0.037
"""Time by which the skin's stamps are late, s."""
COUNTS = 180.0
"""Counts of a taxel at the peak pressure of the reference force."""
NOISE = 1.8
"""Standard deviation of a reading, counts: 1 % of the peak, as the scene has it."""
SILENT = 8
"""Counts up to which a taxel of the log is silent."""
REST, TRAVEL = 0.3, 3.0
"""Time at rest before and after each pass, and on the way to the next one, s."""


@dataclass(frozen=True)
class Exploration:
    """What a simulated exploration is made of."""

    scene: ms.Scene
    recording: Recording
    """What happened: true contact points, forces and pressures."""
    log: SkinLog
    """What the robot wrote."""
    frames: np.ndarray
    """Frame of the log of each contact of the recording."""
    levels: np.ndarray
    """Noiseless excursions (n, t) of the taxels in all frames, counts."""
    robot: JointPath
    """The true joint angles, in the order of the log's."""

    def kinematics(self, **unknown):
        """The robot as its owner knows it, with unknowns by their standard deviations."""
        robot = ms.Robot.from_urdf(PUMA)
        position = self.scene.indenter.position
        return robot.contact_kinematics(
            "tool0", position, mount=self.scene.rig.mount, unknown=unknown
        )

    def pressures(self):
        """The log of a skin that reads pressures, Pa, and of a force on the robot's clock."""
        log, recording = self.log, self.recording
        pressure, force = np.full(log.readings.shape, np.nan), np.zeros(len(log.time))
        column = np.searchsorted(np.asarray(log.taxel_ids), recording.reading_taxel)
        known, rng = self.scene.belief(), np.random.default_rng(5)
        noisy = recording.pressure + rng.normal(0.0, known.noise_sigma, len(recording.pressure))
        row = self.frames[recording.reading_contact]
        pressure[row, column] = np.where(noisy > known.threshold, noisy, np.nan)
        force[self.frames] = recording.force
        force = np.interp(log.time, log.time - CLOCK, force)
        return replace(log, readings=pressure, force=force)

    def streams(self, rate=125.0, seed=1):
        """Times and values by topic, as of a bag: joint states, and raw counts that fall under
        pressure from a level at rest, all taxels in every frame, with noise and drift."""
        rng, log = np.random.default_rng(seed), self.log
        times = np.arange(log.time[0] - 0.05, log.time[-1] + 0.05, 1 / rate)
        angles = self.robot.at(times)[0] - OFFSETS
        rest = rng.uniform(225, 245, log.readings.shape[1])
        drift = 2.0 * (log.time - log.time[0]) / np.ptp(log.time)
        counts = rest + drift[:, None] - self.levels
        counts += rng.normal(scale=NOISE, size=counts.shape)
        return {
            "/joint_states": (times, angles + rng.normal(scale=2e-5, size=angles.shape)),
            "/skin": (log.time, np.clip(np.round(counts), 0, 255).astype(np.float32)),
        }

    def truth(self, label):
        """The true value of an unknown of the robot."""
        if label.startswith("joint_offset"):
            return OFFSETS[self.log.joint_names.index(label.split()[1])]
        return CLOCK if label == "clock_offset" else 0.0


def explore(
    headings=(0, 90, 180, 300), taxels=None, frame=0.02, seed=0, offsets=OFFSETS, clock=CLOCK
):
    """The scene `ellipsoid`, explored once at each of the headings, deg, about the indenter.

    taxels: number of those in the middle that the skin has; None: all.
    """
    scene = ms.Scene.load("ellipsoid")
    if taxels is not None:
        off = np.linalg.norm(scene.skin.positions - scene.skin.positions.mean(axis=0), axis=1)
        kept = np.sort(np.argsort(off)[:taxels])
        skin = ms.Skin(scene.skin.poses[kept], scene.skin.ids[kept], scene.skin.disc_radius)
        scene = scene.with_(skin=skin)
    path = plan_exploration(scene).path
    step = max(round(frame / path.dt), 1)
    rows = np.arange(0, len(path.points), step)
    position = np.array(scene.indenter.position)
    to_tip, arm = inverse(scene.rig.mount), scene.rig.arm
    centres = _centres(scene, path)
    silence = replace(scene.readout, threshold_relative=0.0)
    quiet = without_arm(scene).with_(effects=(), readout=silence)
    recordings, times, angles, touches, begin = [], [], [], [], 0.0
    rng = np.random.default_rng(seed)
    for k, heading in enumerate(headings):
        turn = exp_so3([0.0, 0.0, np.radians(heading)])
        rotations = turn @ path.poses[:, :3, :3]
        poses = transform(rotations, position - np.einsum("kij,kj->ki", rotations, centres))
        fine = arm.inverse_kinematics(poses @ to_tip, arm.solve(poses[0] @ to_tip))
        part = _rows(path, poses, rows, frame)
        recordings.append(press_path(quiet, part, seed + k, None))
        slide = begin + path.dt * np.arange(len(fine))
        rest = np.array([-REST, -REST / 2])
        times += [slide[0] + rest, slide, slide[-1] - rest[::-1]]
        angles += [fine[[0, 0]], fine, fine[[-1, -1]]]
        touches.append(slide[rows])
        begin = slide[-1] + 2 * REST + TRAVEL
    robot = JointPath(np.concatenate(times), np.concatenate(angles))
    recording = recordings[0]
    for other in recordings[1:]:
        recording = concatenate(recording, other)
    away = [np.arange(t[-1] + frame, t[-1] + TRAVEL, frame) for t in touches]
    order = np.argsort(np.concatenate([*touches, *away]))
    true = np.concatenate([*touches, *away])[order]
    levels = _levels(recording, scene, rng)
    levels = np.concatenate([levels, np.zeros((len(true) - len(levels), levels.shape[1]))])[order]
    counts = np.round(levels + rng.normal(scale=NOISE, size=levels.shape))
    counts[(counts <= SILENT) | (levels.max(axis=1) <= SILENT)[:, None]] = np.nan
    read, _ = robot.at(true + clock)
    log = SkinLog(
        time=true + clock,
        joint_names=arm.joint_names,
        joint_angles=read - offsets + rng.normal(scale=2e-5, size=read.shape),
        taxel_ids=np.asarray(scene.skin.ids),
        readings=counts,
        noise=np.full(len(scene.skin), NOISE),
        in_contact=np.isfinite(counts).any(axis=1),
        force=None,
    )
    frames = np.argsort(order)[: len(recording.time)]
    return Exploration(scene, recording, log, frames, levels, robot)


def _centres(scene, path):
    """The indenter's centres (k, 3), body frame, m, at the reference force along a path."""
    patches = scene.model.patches(
        force=scene.law.force_reference,
        curvature=scene.body.closest(path.points).curvature,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    return path.points + (scene.indenter.radius - patches.depth)[:, None] * path.normals


def _rows(path, poses, rows, frame):
    """The path at some of its rows, with other poses."""
    return Path(
        frame, path.points[rows], path.normals[rows], poses[rows], path.twists[rows],
        path.faces[rows],
    )  # fmt: skip


def _levels(recording, scene, rng):
    """Excursions (m, n) of all taxels in counts, each with a gain of its own."""
    ids = list(scene.skin.ids)
    column = np.array([ids.index(taxel) for taxel in recording.reading_taxel])
    pressure = np.zeros((len(recording.time), len(ids)))
    pressure[recording.reading_contact, column] = recording.pressure
    peak = float(np.quantile(recording.pressure, 0.99))
    return COUNTS * np.exp(0.1 * rng.normal(size=len(ids))) * pressure / peak
