"""A robot as its URDF file describes it: links, chains between them, meshes of links as bodies."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_array, check_name, check_real, check_type, read_text
from ..core.arrays import Array
from ..core.atomic_io import write_text
from ..core.errors import ArmError
from ..core.se3 import inverse, is_rigid, transform
from ..core.value import Value
from ..geometry.body import Body
from ..geometry.mesh import link_mesh
from ..skin.skin import Skin
from .chain import Chain, ChainJoint
from .contact_kinematics import USUAL, ContactKinematics
from .urdf import Joint, UrdfTree, rotation
from .urdf_edit import with_moved_shapes, with_moved_zeros

TURNING, SLIDING = ("revolute", "continuous"), ("prismatic",)


@dataclass(frozen=True, eq=False)
class Robot(Value):
    """The links and joints of a URDF file."""

    name: str
    """Name of the robot in the file."""
    path: Path
    """The URDF file."""
    text: str
    """Its text; of a corrected robot, that with the corrections."""
    tree: UrdfTree = field(compare=False)
    """Its links and joints."""
    folders: tuple[Path, ...] = ()
    """Folders that are searched for the links' meshes, besides the file's and its parents."""
    skins: Mapping[str, Skin] = field(default_factory=dict)
    """Skins by the link that they are on, link frame."""

    def __repr__(self) -> str:
        return f"<Robot {self.name!r}: {len(self.links)} links, {len(self.joint_names)} joints>"

    @classmethod
    def from_urdf(
        cls, path: str | Path, meshes: str | Path | Iterable[str | Path] | None = None
    ) -> Robot:
        """The robot of the URDF file at `path`.

        meshes: one or several folders that are searched for the links' meshes (`package://...`),
        besides the file's folder and its parents. Raises ArmError (no file, not a URDF).
        """
        text, path = read_text("the URDF of a robot", path, error=ArmError), Path(path)
        tree = UrdfTree(text, where=f" in {path.name}")
        given = [] if meshes is None else meshes
        given = [given] if isinstance(given, str | os.PathLike) else given
        name = tree.root.get("name") or path.stem
        return cls(name, path, text, tree, tuple(Path(folder) for folder in given))

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links, in the order of the file."""
        return tuple(self.tree.links)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints that mimic no other, in the order of the file."""
        return tuple(j.name for j in self.tree.joints if j.kind != "fixed" and j.mimic is None)

    @property
    def root(self) -> str:
        """Name of the link that no joint moves."""
        moved = {j.child for j in self.tree.joints}
        return next(link for link in self.links if link not in moved)

    def chain(self, base: str, tip: str) -> Chain:
        """The chain from the link `base` to the link `tip`, through the link where they meet.

        Its angles are those of the moving joints on the way, in order; a joint that mimics another
        has that one's. Raises UnknownNameError, ArmError (a joint of another kind).
        """
        up, down = self.tree.chain(base), self.tree.chain(tip)
        shared = len({j.name for j in up} & {j.name for j in down})  # in a tree, the first ones
        names: list[str] = []
        moving: list[ChainJoint] = []
        pose = np.eye(4)
        steps = [(j, True) for j in reversed(up[shared:])] + [(j, False) for j in down[shared:]]
        for joint, upward in steps:
            origin = transform(rotation(joint.rpy), joint.xyz)
            before, after = (np.eye(4), inverse(origin)) if upward else (origin, np.eye(4))
            pose = pose @ before
            if joint.kind != "fixed":
                moving.append(self._chain_joint(joint, pose, upward, names))
                pose = np.eye(4)
            pose = pose @ after
        return Chain(tuple(names), tuple(moving), pose)

    def _chain_joint(
        self, joint: Joint, origin: Array, upward: bool, names: list[str]
    ) -> ChainJoint:
        """A moving joint of a chain; appends the angle that drives it to `names` if it is new."""
        if joint.kind not in TURNING + SLIDING:
            raise ArmError(
                f"joint {joint.name!r}{self.tree.where} is {joint.kind}",
                limit=" or ".join(TURNING + SLIDING),
            )
        by = self.tree.resolve_mimic(joint)
        if by.joint not in names:
            names.append(by.joint)
        sign = -1.0 if upward else 1.0  # from the child to the parent the joint moves backwards
        column, slides = names.index(by.joint), joint.kind in SLIDING
        multiplier, offset = sign * by.multiplier, sign * by.offset
        return ChainJoint(origin, joint.axis, slides, column, multiplier, offset)

    def with_joint_offsets(self, offsets: Mapping[str, float]) -> Robot:
        """This robot with joints whose zeros are where their readings are zero.

        offsets: what is to be added to the reading of each joint, by name, rad (m where it slides),
        as `LogCalibration.joint_offsets` has it: at the same readings, the links of the result are
        where those of this robot are at the readings with the offsets. They go into the origins of
        the joints, and of those that mimic them; limits are kept, as those of the readings. Raises
        UnknownNameError, ArmError, ConfigError for offsets without names.
        """
        check_type(Mapping, offsets, "offsets of joints")
        for name, value in offsets.items():
            check_name("joint", name, self.joint_names)
            check_real(f"offset of joint {name}", value, error=ArmError)
        moved = {}
        for joint in self.tree.joints:
            by = self.tree.resolve_mimic(joint)
            if joint.kind in TURNING + SLIDING and by.joint in offsets:
                moved[joint.name] = joint, by.multiplier * float(offsets[by.joint])
        return self._with_text(with_moved_zeros(self.text, moved))

    def with_moved_shapes(self, link: str, pose: ArrayLike, scale: float = 1.0) -> Robot:
        """This robot with a link's visual and collision shapes elsewhere; its frame stays.

        The shapes are scaled about the origin of the link's frame, then moved by `pose` (4, 4), m.
        Raises UnknownNameError, ArmError.
        """
        check_name("link", link, self.links)
        check_real("scale of shapes", scale, above=0.0, error=ArmError)
        if not is_rigid(pose):
            raise ArmError("pose of shapes must be a rigid transform (4, 4)", value=pose)
        moved = with_moved_shapes(self.text, link, np.asarray(pose), scale, self.tree.where)
        return self._with_text(moved)

    def _with_text(self, text: str) -> Robot:
        return replace(self, text=text, tree=UrdfTree(text, self.tree.where))

    def save(self, path: str | Path) -> None:
        """Write the URDF file, as the original but for corrections. Raises OutputError."""
        write_text(Path(path), self.text)

    def with_skin(self, link: str, skin: Skin) -> Robot:
        """This robot with a skin, link frame, on a link. Raises UnknownNameError, ConfigError."""
        check_name("link", link, self.links)
        check_type(Skin, skin, "the skin on a link")
        return replace(self, skins={**self.skins, link: skin})

    def taxel_poses(self, link: str, base: str, angles: ArrayLike) -> Array:
        """Poses (n, t, 4, 4), m, of the taxels on `link` in the frame of the link `base`.

        angles (n, k): of the joints of `chain(base, link)`. Raises UnknownNameError, ArmError.
        """
        check_name("link", link, self.links)
        if link not in self.skins:
            raise ArmError(f"link {link!r} has no skin", remedy="give it one by with_skin")
        poses = self.chain(base, link).poses(angles)
        return np.asarray(poses[:, None] @ self.skins[link].poses)

    def body(self, link: str, kind: str = "visual", open: bool = False) -> Body:
        """The body of a link's meshes, link frame, as `Body.from_urdf`; with the corrections.

        Raises MeshError, UnknownNameError.
        """
        raw = link_mesh.in_tree(self.tree.root, self.path, link, self.folders, kind)
        return Body.from_triangles(link, raw, open)

    def contact_kinematics(
        self,
        link: str,
        indenter: ArrayLike,
        carrier: str | None = None,
        mount: ArrayLike | None = None,
        unknown: Mapping[str, float] = USUAL,
    ) -> ContactKinematics:
        """A body on `link` that touches an indenter, whose contacts follow from joint angles.

        indenter (3,): its centre, m, in the frame of the link `carrier`, by default the root.
        mount: T_link_body (4, 4), by default the identity, as of `body`. unknown: standard
        deviations of what is not known exactly, by name, as `ContactKinematics.unknown`. Raises
        UnknownNameError, ArmError.
        """
        chain = self.chain(link, self.root if carrier is None else carrier)
        centre = check_array("centre of the indenter", indenter, error=ArmError)
        pose = np.eye(4) if mount is None else check_array("mount", mount, error=ArmError)
        return ContactKinematics(chain, centre, pose, unknown)
