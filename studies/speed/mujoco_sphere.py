"""The paper's sphere in MuJoCo: the same arm, body, indenter and taxels, for speed comparisons."""

from __future__ import annotations

import re
from time import process_time

import mujoco
import numpy as np

import meshskin as ms
from meshskin.geometry.primitives import Sphere
from meshskin.simulation.simulate import prepare

RESET = 200
"""Steps after which the bare simulation starts again, so that it stays in contact."""


class Peer:
    """A MuJoCo model of a scene on a sphere, at rest in contact at the reference force."""

    def __init__(self, scene: ms.Scene) -> None:
        machine, path = prepare(scene)
        self.scene, self.loop = scene, machine.loop
        self.model = _model(scene, machine.loop.arm)
        self.data = mujoco.MjData(self.model)
        tip_body = np.linalg.inv(scene.mount_pose)
        self.reference = path.poses[0]
        self.home = self.loop.arm.inverse_kinematics(path.poses[:1] @ tip_body, machine.state[:6])
        self.body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, "body")
        self.tip = int(self.model.geom_bodyid[self.body])
        # MuJoCo's contact is a linear spring: of a stiffness that gives the reference force here
        self.reset()
        self.model.geom_solref[:, 0] *= scene.law.force_reference / self.force()

    def reset(self) -> None:
        """At rest in contact, the weight carried."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.home[0]
        mujoco.mj_forward(self.model, self.data)
        self.data.qfrc_applied[:] = self.data.qfrc_bias
        mujoco.mj_forward(self.model, self.data)

    def bare(self, steps: int) -> float:
        """Steps a second of mj_step in C, under constant torques that carry the arm."""
        data, seconds = self.data, 0.0
        for _ in range(steps // RESET):
            self.reset()
            data.qfrc_applied[:] -= data.qfrc_constraint
            started = process_time()
            mujoco.mj_step(self.model, data, RESET)
            seconds += process_time() - started
            assert data.ncon == 1
            assert data.sensordata.size == len(self.scene.skin.ids)
        return steps // RESET * RESET / seconds

    def with_law(self, steps: int) -> float:
        """Steps a second with the compliance law in NumPy."""
        self.reset()
        started = process_time()
        for _ in range(steps):
            self.data.qfrc_applied[:] = self.torque()
            mujoco.mj_step(self.model, self.data)
        seconds = process_time() - started
        assert abs(self.force() - self.scene.law.force_reference) < 0.1
        return steps / seconds

    def force(self) -> float:
        """Normal force, N."""
        return float(self.data.efc_force[0]) if self.data.ncon else 0.0

    def torque(self) -> np.ndarray:
        """The law's torques (6,): hold the force, hold the pose, at the contact point."""
        model, data, law = self.model, self.data, self.scene.law
        rotation = data.xmat[self.tip].reshape(3, 3) @ self.scene.mount_pose[:3, :3]
        centre = data.geom_xpos[self.body]
        reach = self.loop.indenter_position - centre
        distance = np.sqrt(reach @ reach)
        normal = reach / distance
        radius = _radius(self.scene)
        depth = radius + self.loop.indenter_radius - distance
        lever = radius * normal
        point = centre + lever
        linear, angular = np.empty((3, 6)), np.empty((3, 6))
        mujoco.mj_jac(model, data, linear, angular, point, self.tip)
        jacobian = np.concatenate([linear, angular])
        relative = 1.0 / (1.0 / radius + 1.0 / self.loop.indenter_radius)
        e_star = self.loop.effective_modulus
        wanted = (0.75 * law.force_reference / e_star) ** (2 / 3) / relative ** (1 / 3)
        stiffness = 4 / 3 * e_star * np.sqrt(relative)
        force = self.force()
        speed = law.gamma * (law.force_reference - force)
        speed /= 1.5 * stiffness * np.sqrt(max(depth, 0.25 * wanted))
        speed = min(max(speed, -law.approach_speed), law.approach_speed)
        centre_rows = np.empty((3, 6))
        mujoco.mj_jac(model, data, centre_rows, None, centre, self.tip)
        push = centre_rows.T @ np.linalg.solve(centre_rows @ centre_rows.T, speed * normal)
        goal = self.reference
        miss = goal[:3, :3] @ rotation.T
        turn = 0.5 * np.array(
            [miss[2, 1] - miss[1, 2], miss[0, 2] - miss[2, 0], miss[1, 0] - miss[0, 1]]
        )
        omega = law.tracking * turn
        velocity = law.tracking * (goal[:3, 3] - centre) + cross(omega, lever)
        velocity -= normal * (normal @ velocity)
        gram = jacobian @ jacobian.T + np.diag([1e-12] * 3 + [4e-4] * 3)
        along = jacobian.T @ np.linalg.solve(gram, np.concatenate([velocity, omega]))
        mass = np.empty((6, 6))
        mujoco.mj_fullM(model, data, mass)
        excess = data.qvel - push - along
        return data.qfrc_bias - law.rate * mass @ excess + linear.T @ (force * normal)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product; np.cross takes some 20 us."""
    (a1, a2, a3), (b1, b2, b3) = a.tolist(), b.tolist()
    return np.array([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])


def _radius(scene: ms.Scene) -> float:
    """Radius of the scene's body, m, which is a sphere."""
    exact = scene.body.exact
    assert isinstance(exact, Sphere)
    return exact.radius


def _model(scene: ms.Scene, arm: ms.Arm) -> mujoco.MjModel:
    """The arm's URDF with the sphere, its taxels as touch sensors, and the indenter."""
    # the published inertias of links 1 and 3 are none of a rigid body: MuJoCo mends what it refuses
    options = (
        '<mujoco><compiler balanceinertia="true" boundinertia="1e-4" fusestatic="false"/></mujoco>'
    )
    urdf = re.sub(r"(<robot[^>]*>)", rf"\1{options}", arm.urdf, count=1)
    spec = mujoco.MjSpec.from_string(urdf)
    spec.option.timestep = scene.loop.dt
    spec.option.gravity = [0.0, 0.0, -9.80665]
    for body in spec.bodies:
        if body.explicitinertial:
            full = np.array(body.fullinertia)
            full[:3] = np.maximum(full[:3], 1e-4)
            body.fullinertia, body.mass = full, max(body.mass, 1e-3)
    for joint, inertia in zip(spec.joints, arm.reflected_inertia, strict=True):
        joint.armature = inertia
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    tip, pose = spec.body(arm.tip), scene.mount_pose
    depth = scene.patch.depth
    stiffness = 1.5 * scene.law.force_reference / depth
    # low impedance: a spring, not a constraint that answers the law's torques at once
    contact = {
        "condim": 1, "solref": [-stiffness, -10.0], "solimp": [0.01, 0.01, 1e-3, 0.5, 2.0]
    }  # fmt: skip
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    radius = _radius(scene)
    tip.add_geom(name="body", type=kind, size=[radius, 0, 0], pos=pose[:3, 3], mass=0, **contact)
    spec.worldbody.add_geom(
        name="indenter", type=kind, size=[scene.indenter.radius, 0, 0],
        pos=list(scene.indenter.position), **contact,
    )  # fmt: skip
    for k, position in enumerate(scene.skin.positions):
        site = tip.add_site(
            name=f"taxel{k}", type=kind, size=[scene.skin.disc_radius, 0, 0],
            pos=pose[:3, :3] @ position + pose[:3, 3],
        )  # fmt: skip
        spec.add_sensor(
            name=f"touch{k}", type=mujoco.mjtSensor.mjSENS_TOUCH,
            objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name,
        )  # fmt: skip
    model: mujoco.MjModel = spec.compile()
    return model
