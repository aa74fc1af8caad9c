"""Meshes of a robot's links for pictures, and where the links are at given joint angles.

A link is drawn by its visual shapes, or by its collision shapes where no visual one can be read; a
link without either is a rod from its frame to each joint that it carries.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import Array
from ..core.se3 import shortest_rotation, transform, transform_points
from ..geometry.mesh import link_mesh
from ..geometry.mesh.triangles import Triangles
from .link_shapes import geometry_of, of_shapes
from .urdf import UrdfTree

if TYPE_CHECKING:
    from .chain import Chain
    from .robot import Robot

ROD_RADIUS = 0.02
"""Radius of the rods of a link without shapes, m: slimmer than most links, so that it is not taken
for a measured shape. Chosen."""
JOINT_RADIUS = 1.5 * ROD_RADIUS
"""Radius of the balls at the ends of rods, m. Chosen."""
MIN_ROD = 1e-3
"""Length up to which a rod is not drawn, m: joints of a wrist share one point. Chosen."""


def link_meshes(tree: UrdfTree, folders: Iterable[str | Path] = ()) -> dict[str, Triangles]:
    """The triangles, m, of each link in its own frame; a link with nothing to draw is left out.

    folders: searched for the files of the meshes.
    """
    where = list(folders)
    found = {name: _shapes(link, where) or _rods(tree, name) for name, link in tree.links.items()}
    return {name: Triangles.joined(parts) for name, parts in found.items() if parts}


class LinkPoses:
    """Where some links of a robot are, one posture at a time."""

    def __init__(self, robot: Robot, links: Iterable[str]) -> None:
        """Raises UnknownNameError for a link that the robot does not have."""
        self.root, self.links = robot.root, tuple(links)
        self._steps: dict[str, tuple[str, Chain]] = {}
        for link in self.links:
            for joint in robot.tree.chain(link):
                if joint.child not in self._steps:
                    step = robot.chain(joint.parent, joint.child)
                    self._steps[joint.child] = joint.parent, step

    def at(self, angles: Mapping[str, float]) -> dict[str, Array]:
        """Poses (4, 4), m, of the links in the frame of the root link.

        angles: positions, rad or m, by the name of the joint; other joints are at zero.
        """
        poses = {self.root: np.eye(4)}
        for link, (parent, step) in self._steps.items():
            own = np.array([[angles.get(name, 0.0) for name in step.joint_names]])
            poses[link] = poses[parent] @ step.poses(own)[0]
        return {link: poses[link] for link in self.links}


def _shapes(link: ET.Element, folders: list[str | Path]) -> list[Triangles]:
    """The triangles of a link's visual shapes; of its collision shapes if none can be read."""
    return of_shapes(link, link_mesh.KINDS, lambda shape: _placed(shape, folders))[0]


def _placed(shape: ET.Element, folders: list[str | Path]) -> list[Triangles]:
    """The triangles of one shape, in the frame of its link. Raises MeshError."""
    from trimesh import creation

    kind, pose, size = geometry_of(shape)
    if kind == "mesh":
        return [link_mesh.placed(shape, folders, " of a link")]
    radius, length = (float(size.get(key, [0.0])[0]) for key in ("radius", "length"))
    if kind == "box":
        made = creation.box(extents=size["size"])
    elif kind == "cylinder":
        made = creation.cylinder(radius=radius, height=length, sections=32)
    elif kind == "capsule":
        made = creation.capsule(height=length, radius=radius)
    else:
        made = creation.icosphere(subdivisions=2, radius=radius)
    return [Triangles(transform_points(pose, made.vertices), np.asarray(made.faces))]


def rod(end: Array) -> Triangles:
    """A rod from the origin to `end` (3,), m."""
    from trimesh import creation

    length = float(np.linalg.norm(end))
    made = creation.cylinder(radius=ROD_RADIUS, height=length, sections=24)
    turn = shortest_rotation([0.0, 0.0, 1.0], end / length)
    return Triangles(
        transform_points(transform(turn, end / 2), made.vertices), np.asarray(made.faces)
    )


def _rods(tree: UrdfTree, name: str) -> list[Triangles]:
    """A ball and a rod from the link's frame to each joint that it carries."""
    from trimesh import creation

    parts = []
    for joint in tree.joints:
        if joint.parent == name:
            ball = creation.icosphere(subdivisions=2, radius=JOINT_RADIUS)
            parts.append(Triangles(ball.vertices + joint.xyz, np.asarray(ball.faces)))
            if np.linalg.norm(joint.xyz) > MIN_ROD:
                parts.append(rod(joint.xyz))
    return parts
