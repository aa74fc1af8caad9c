"""What a robot's log shows: its skin, unknowns of the robot, and what contradicts the belief."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import gammaincc

from ...core.arrays import Array
from ...core.notebook import Card
from ...core.se3 import inverse
from ...core.value import Value
from ...recording.recording import Recording
from ...robot.contact_kinematics import ContactKinematics
from ..calibration import Calibration
from .joint_residuals import JointResidual
from .pulled import CONTRADICTED, contradicted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...robot.robot import Robot

MIN_CHANCE = 0.01
"""Probability of all unknowns together, under what was believed of them, from which they contradict
it: about that of one beyond CONTRADICTED."""
AT_REST = 0.3
"""Move of the contacts in the last round, relative to the taxels' median standard deviation, up to
which they are at rest: it would add 4 % to that."""
MAX_DEPTH_FACTOR = 2.2
"""Depth of the indentations, relative to that under the believed material and force, or its
inverse, from which the indenter's height is in doubt: beyond 3^(2/3) = 2.08, the depth under an E*
or a force that is wrong by a factor of 3, from which the verdict doubts E*."""


@dataclass(frozen=True, eq=False)
class LogCalibration(Value, Card):
    """A calibrated skin, and what the log shows of the robot."""

    calibration: Calibration
    """The skin; the robot's unknowns are among `calibration.unknowns`."""
    recording: Recording
    """The contacts as they were last computed, with the readings."""
    kinematics: ContactKinematics
    """What was believed of the robot, with the declared unknowns."""
    heights: Array
    """Heights (m,), m, of the indenter over those of a contact, at the estimate."""
    heights_before: Array
    """Heights (m,), m, over those of a contact, with all unknowns zero."""
    rounds: int
    """Number of times that the contacts were computed."""
    moved: float = 0.0
    """Median displacement, m, of the contacts in the last round, where it is too large for the
    estimate to hold; 0 where they are at rest."""
    depth_factor: float = 1.0
    """Depth of the indentations, relative to that under the believed material and force."""
    joint_residuals: tuple[JointResidual, ...] = ()
    """What an error of each joint that varies with its angle would explain of `heights`."""
    failure: str = ""
    """Why the calibration with the contacts as they were found failed, and is that of the round
    before; empty where it did not."""
    off_body: int = 0
    """Number of contacts that were left out as they lie off the body where the others lie on it."""

    def facts(self) -> dict[str, str]:
        """The facts of the calibration, and what the log shows of the robot, for a notebook."""
        before, after = self.heights_mm
        heights = f"{before:.3g} mm off the body before, {after:.2g} mm after the estimate"
        facts = {**self.calibration.facts(), "contacts": heights}
        return facts | (
            {"contradictions": "; ".join(self.contradictions)} if self.contradictions else {}
        )

    @property
    def heights_mm(self) -> tuple[float, float]:
        """Medians of the heights without signs, mm, before the estimate and after it."""
        before, after = np.abs(self.heights_before), np.abs(self.heights)
        return 1e3 * float(np.median(before)), 1e3 * float(np.median(after))

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the calibrated skin: `Calibration.plot`."""
        return self.calibration.plot(ax)

    @property
    def unknowns(self) -> Mapping[str, tuple[float, float]]:
        """Value and standard deviation of each of the robot's unknowns, by
        `ContactKinematics.labels`, in SI units and rad."""
        found = self.calibration.unknowns
        return {label: found[label] for label in self.kinematics.labels}

    @property
    def joint_offsets(self) -> Mapping[str, tuple[float, float]]:
        """What to add to the reading of each joint, by its name, with the standard deviation, rad
        (m where it slides)."""
        names = self.kinematics.chain.joint_names
        labels = {name: f"joint_offset {name}" for name in names}
        return {n: self.unknowns[label] for n, label in labels.items() if label in self.unknowns}

    @property
    def mount(self) -> Array:
        """Estimated T_link_body (4, 4)."""
        return self.kinematics.mount_at(self._values)

    @property
    def _values(self) -> Array:
        return np.array([value for value, _ in self.unknowns.values()])

    def corrected(self, robot: Robot, link: str) -> Robot:
        """The robot with its joints' offsets, and with the shapes of the `link` that carries the
        body at the estimated mount and size. Raises UnknownNameError, ArmError."""
        offsets = {name: value for name, (value, _) in self.joint_offsets.items()}
        robot = robot.with_joint_offsets(offsets)
        if not {"mount", "mesh_scale"} & self.kinematics.columns.keys():
            return robot
        scale = float(np.exp(self.kinematics.value("mesh_scale", self._values)))
        pose = self.mount @ inverse(self.kinematics.mount)
        # the body is scaled about the origin of its own frame, the shapes about that of the link's
        pose[:3, 3] = self.mount[:3, 3] - scale * pose[:3, :3] @ self.kinematics.mount[:3, 3]
        return robot.with_moved_shapes(link, pose, scale)

    def metrics(self) -> dict[str, Any]:
        """Heights of the contacts and residuals by joint as JSON values."""
        before, after = self.heights_mm
        offsets = self.joint_offsets
        joints = {
            found.joint: {
                "offset_rad": list(offsets[found.joint]) if found.joint in offsets else None,
                "error_rad": found.error,
                "explained": found.explained,
                "chance": found.chance,
            }
            for found in self.joint_residuals
        }
        heights = {"height_before_mm": before, "height_mm": after, "off_body": self.off_body}
        return {**heights, "joints": joints}

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Unknowns that are farther from zero than was believed of them, in words: a wrong standard
        deviation, or an error that is not declared and that they stand in for; and contacts that
        have not come to rest."""
        sigma = dict(zip(self.kinematics.labels, self.kinematics.sigma, strict=True))
        square = sum((value / sigma[label]) ** 2 for label, (value, _) in self.unknowns.items())
        chance = float(gammaincc(len(sigma) / 2, square / 2)) if sigma else 1.0
        found = [
            f"{label} is {value:.3g}, {abs(value) / sigma[label]:.2g} times its believed standard "
            f"deviation of {sigma[label]:.3g}"
            for label, (value, _) in self.unknowns.items()
            if abs(value) > CONTRADICTED * sigma[label]
        ]
        found += contradicted(self.calibration)
        if not found and chance < MIN_CHANCE:
            far = sorted(
                self.unknowns, key=lambda label: -abs(self.unknowns[label][0]) / sigma[label]
            )
            found.append(
                "the robot's unknowns together are farther from what was believed than their "
                f"standard deviations allow, p = {chance:.1g} (limit {MIN_CHANCE:g}), most of all "
                f"{' and '.join(far[:2])}: joints stamped at different times, or an error that is "
                "not declared, would look like this"
            )
        if not 1 / MAX_DEPTH_FACTOR < self.depth_factor < MAX_DEPTH_FACTOR:
            found.append(
                f"indentations are {self.depth_factor:.2g} times as deep as believed (limit: a "
                f"factor of {MAX_DEPTH_FACTOR:g}): an error of the indenter's height or radius "
                "would look like this; check both, the force and Young's modulus"
            )
        stated = self.calibration.position_sigma
        stated = stated[np.isfinite(stated)]
        if len(stated) and self.moved > AT_REST * np.median(stated):
            found.append(
                f"contacts still moved by {1e3 * self.moved:.2g} mm in the last of {self.rounds} "
                "rounds: the standard deviations can be too small; calibrate again from what was "
                "found, with the corrected URDF"
            )
        if self.failure:
            found.append(
                f"contacts were not computed again after round {self.rounds}, whose result this "
                f"is: {self.failure}; or calibrate again with the corrected URDF"
            )
        return tuple(found)
