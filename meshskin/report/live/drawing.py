"""The 3D part of the live page: nodes of a viser scene, placed once and moved with every snapshot.

Nodes hang on two frames: `/body` (body, taxels, patch, next touch) and `/world` (robot, indenter's
support). In the view of the skin the body is at rest and the world moves about it; in the view of
the robot it is the other way round.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...core.arrays import Array
from ...core.se3 import inverse, orthonormal_basis, quaternion, transform, transform_points
from .. import scene3d
from ..plane import tangent_plane
from . import marks
from .replay import Snapshot
from .stage import Carrier, Stage

SKIN, BODY, ROBOT = VIEWS = ("skin", "body", "robot")
"""What is at rest in the picture."""
BODY_FACES, LINK_FACES = 20_000, 3_000
"""Most faces of the body and of a link: 0.5 and 0.07 MB, which a browser draws at full rate."""
BODY_COLOR, LINK_COLOR, INDENTER_COLOR = (184, 190, 199), (150, 158, 168), (86, 96, 110)
LIFT = 2e-4
"""Height of discs above the surface, m: flat marks would flicker where the mesh is coarse."""
AMBIENT, LAMP = 2.0, 1.4
"""Light from all sides and from the camera's side. Chosen by looking: surfaces that face the camera
have the colours of the legend, others are darker."""
LAMP_DISTANCE = 100.0
"""Distance of the lamp, m: far from everything, so that it shines in one direction."""
SKIN_DISTANCE, ROBOT_DISTANCE = 2.8, 1.5
"""Distance of the camera in units of the radius of the skin, and of the robot, which is slim.
Chosen by looking."""
BODY_DISTANCE = 1.65
"""Distance of the camera in units of the radius of the sphere around the body, which fills viser's
field of view then: 1 / sin(75 degrees / 2)."""
HIDDEN = 1e-6
"""Size of a mark that is not shown: a size of zero has no normals."""


class Drawing:
    """The nodes of a stage on a viser scene."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """scene: the `scene` of a viser server."""
        self.scene, self.stage = scene, stage
        self.nodes: dict[str, Any] = {}
        self.view = SKIN
        self.magnified = marks.MAGNIFIED
        scene.set_up_direction("+z")
        for name in ("/body", "/world"):
            self.nodes[name] = scene.add_frame(name, show_axes=False)
        self._add_lights()
        self._add_body()
        self._add_robot()
        self._add_taxels()
        self._add_contact()

    def _mesh(self, name: str, vertices: Array, faces: Any, color: Any, **style: Any) -> None:
        self.nodes[name] = self.scene.add_mesh_simple(
            name, np.asarray(vertices, dtype=np.float32), faces, color=color, **style
        )

    def _batch(self, name: str, shape: Any, count: int, color: Any, **style: Any) -> None:
        """Copies of one mesh, hidden until they are placed."""
        vertices, faces = shape
        self.nodes[name] = self.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=np.zeros((count, 3)),
            batched_scales=np.full((count, 3), HIDDEN),
            batched_colors=np.tile(marks.linear(color), (count, 1)),
            lod="off",
            cast_shadow=False,
            **style,
        )

    def _add_lights(self) -> None:
        """Light from all sides and from the camera's: colours are those of the legend."""
        self.scene.configure_default_lights(enabled=False)
        self.scene.configure_environment_map(None)
        self.scene.add_light_ambient("/ambient", intensity=AMBIENT)
        self.nodes["/lamp"] = self.scene.add_light_directional("/lamp", intensity=LAMP)

    def _add_body(self) -> None:
        facets = self.stage.belief.body.facets
        focus = self.stage.recording.points
        mesh = scene3d.decimate(facets.vertices, facets.faces, focus, BODY_FACES)
        self._mesh("/body/mesh", *mesh, BODY_COLOR, side="double", cast_shadow=False)

    def _add_robot(self) -> None:
        if self.stage.carrier is None:
            return
        for name, link in self.stage.carrier.links.items():
            none = np.empty((0, 3))
            vertices, faces = scene3d.decimate(link.vertices, link.faces, none, LINK_FACES)
            corners = vertices[faces].reshape(-1, 3)  # edges of links stay sharp
            triangles = np.arange(len(corners)).reshape(-1, 3)
            self._mesh(f"/world/robot/{name}", corners, triangles, LINK_COLOR, side="double")

    def _add_taxels(self) -> None:
        from trimesh.creation import icosphere

        count = len(self.stage.belief.taxel_ids)
        ball = icosphere(subdivisions=1)
        self._batch("/body/taxels", marks.disc(), count, marks.UNSEEN)
        self._batch("/body/sigma", (ball.vertices, ball.faces), count, marks.SIGMA, opacity=0.6)
        if (truth := self.stage.truth) is not None:
            self._batch("/body/truth", marks.ring(), len(truth), marks.TRUTH)
            self._place_on_body("/body/truth", truth, 1.15 * self.stage.belief.disc_radius)

    def _add_contact(self) -> None:
        from trimesh.creation import cylinder, icosphere

        radius = self.stage.belief.indenter.radius
        ball = icosphere(subdivisions=3, radius=radius)
        self._mesh("/body/indenter", ball.vertices, ball.faces, INDENTER_COLOR, opacity=0.4)
        if self.stage.column is not None:
            wide, height = self.stage.column
            rod = cylinder(radius=wide, height=height, sections=32)
            below = np.asarray(rod.vertices) - [0.0, 0.0, radius + 0.5 * height]
            self._mesh("/body/indenter/support", below, rod.faces, INDENTER_COLOR, opacity=0.4)
        self._mesh("/body/patch", *marks.disc(48), marks.PATCH, opacity=0.8, visible=False)
        self._mesh("/body/next", *marks.arrow(1.5 * radius), marks.NEXT, visible=False)

    def show(self, snapshot: Snapshot) -> None:
        """Move everything to a snapshot."""
        self._show_estimate(snapshot)
        self._show_contact(snapshot.row)
        self.place(snapshot.row)
        touch = snapshot.status.next_touch
        self._show_next(None if touch is None else np.asarray(touch.point))

    def _show_estimate(self, snapshot: Snapshot) -> None:
        sigma = marks.position_sigma(snapshot.covariances)
        colors = marks.linear(marks.sigma_colors(sigma))
        self._place_on_body("/body/taxels", snapshot.positions, self.stage.belief.disc_radius)
        self.nodes["/body/taxels"].batched_colors = colors
        axes, turns = marks.ellipsoids(snapshot.covariances, self.magnified)
        known = np.asarray(np.isfinite(snapshot.positions).all(axis=1))
        node, places = self.nodes["/body/sigma"], np.zeros((len(known), 3))
        if known.any():  # on the discs, which would hide them
            hit = self.stage.belief.body.closest(snapshot.positions[known])
            above = 2 * LIFT + marks.DISC_HEIGHT * self.stage.belief.disc_radius
            places[known] = snapshot.positions[known] + above * hit.normal
        node.batched_positions, node.batched_wxyzs = places, _wxyz(turns)
        node.batched_scales = np.where(known[:, None], np.maximum(axes, HIDDEN), HIDDEN)

    def _place_on_body(self, name: str, points: Array, size: float) -> None:
        """Place the marks of a batch at points (k, 3), m, upright on the surface; hide the rest."""
        node, known = self.nodes[name], np.isfinite(points).all(axis=1)
        rows = np.flatnonzero(known)
        count = len(node.batched_positions)
        place, turn = np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        if len(rows):
            hit = self.stage.belief.body.closest(points[rows])
            place[rows] = points[rows] + LIFT * hit.normal
            turn[rows] = _wxyz(orthonormal_basis(hit.normal))
        scale = np.full((count, 3), HIDDEN)
        scale[rows] = size
        node.batched_positions, node.batched_wxyzs, node.batched_scales = place, turn, scale

    def _show_contact(self, row: int) -> None:
        contact = self.stage.contact(row)
        _move(self.nodes["/body/indenter"], contact.indenter)
        lifted = contact.patch @ transform(np.eye(3), [0.0, 0.0, 2 * LIFT])
        node = self.nodes["/body/patch"]
        _move(node, lifted)
        node.visible = bool(np.isfinite(contact.semi_axes).all())
        if node.visible:
            node.scale = (*contact.semi_axes.tolist(), LIFT)

    def _show_next(self, point: Array | None) -> None:
        """Put the tip of the arrow at a point (3,), m, of the body; None: hide it."""
        node = self.nodes["/body/next"]
        node.visible = point is not None
        if point is not None:
            hit = self.stage.belief.body.closest(point[None])
            _move(node, transform(orthonormal_basis(hit.normal)[0], hit.point[0]))

    def place(self, row: int) -> None:
        """Put body, world and links where they are at contact `row`, by the present view."""
        carrier = self.stage.carrier
        if carrier is None:
            return
        for name, pose in carrier.link_poses(row).items():
            _move(self.nodes[f"/world/robot/{name}"], pose)
        body = carrier.body[row]
        still = self.view != ROBOT
        _move(self.nodes["/body"], np.eye(4) if still else body)
        _move(self.nodes["/world"], inverse(body) if still else np.eye(4))

    def camera(self, row: int) -> tuple[Array, Array, Array]:
        """Position, target and upward direction (3,) each, m, that show the present view."""
        if self.view == ROBOT and self.stage.carrier is not None:
            return self._camera_on_robot(self.stage.carrier, row)
        points = self.stage.recording.points
        # a log need not have normals
        plane = tangent_plane(points, self.stage.belief.body.closest(points).normal)
        across, up = plane.axes
        outward = np.cross(across, up)
        radius = float(np.max(np.linalg.norm(points - plane.origin, axis=1), initial=0.02))
        direction = 0.85 * outward - 0.45 * up + 0.3 * across
        if self.view == BODY:
            mesh = self.stage.belief.body.mesh
            centre = mesh.bounds.mean(axis=0)
            around = float(np.max(np.linalg.norm(mesh.vertices - centre, axis=1)))
            return centre + BODY_DISTANCE * around * direction, centre, up
        return plane.origin + SKIN_DISTANCE * radius * direction, plane.origin, up

    def light_from(self, direction: Array) -> None:
        """Put the lamp in a direction (3,)."""
        self.nodes["/lamp"].position = LAMP_DISTANCE * direction / np.linalg.norm(direction)

    def _camera_on_robot(self, carrier: Carrier, row: int) -> tuple[Array, Array, Array]:
        """A view of the whole robot from the side on which its body is."""
        body = transform_points(carrier.body[row], self.stage.belief.body.mesh.bounds)
        origins = [pose[:3, 3] for pose in carrier.link_poses(row).values()]
        every = np.concatenate([body, np.reshape(origins, (-1, 3))])
        low, high = every.min(axis=0), every.max(axis=0)
        centre, up = (low + high) / 2, np.array([0.0, 0.0, 1.0])
        side = body.mean(axis=0) - centre
        side[2] = 0.0
        length = float(np.linalg.norm(side))
        side = side / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        direction = 0.7 * side + 0.7 * np.cross(up, side) + 0.35 * up
        size = 0.5 * float(np.linalg.norm(high - low))
        return centre + ROBOT_DISTANCE * size * direction, centre, up


def _wxyz(rotations: Array) -> Array:
    """Quaternions (..., 4), w first, of rotations (..., 3, 3)."""
    return np.roll(quaternion(rotations), 1, axis=-1)


def _move(node: Any, pose: Array) -> None:
    """Set the pose (4, 4) of a node."""
    node.position, node.wxyz = pose[:3, 3], _wxyz(pose[:3, :3])
