"""A skin of separate pins on springs, in MuJoCo: a taxel is the flat end of a pin.

Every contact is a rigid-body simulation: the indenter, a sphere that slides along the contact
normal under the contact force, comes to rest on the pins that it reaches, and each pin's touch
sensor says what it carries. The force divides among few pins, so that a reading depends on where
the neighbours are: no profile of the distance alone describes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from . import sphere
from .profiles import Array
from .sphere import Touch

STEP, SETTLED, MAX_STEPS = 2e-4, 1e-6, 2000
"""Time step, s; speed, m/s, below which all is at rest; steps within which it has to be."""
LENGTH, PIN_MASS, INDENTER_MASS = 4e-3, 2e-4, 2e-3
"""Length of a pin, m, and masses, kg."""


@dataclass(frozen=True)
class Pins:
    """The pressures of pins on the taxels' discs."""

    stiffness: float = 800.0
    """Of a pin's spring, N/m."""

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Force on each pin (m, n) over its area, Pa. Raises RuntimeError without a rest."""
        model = mujoco.MjModel.from_xml_string(self._xml(positions))
        data = mujoco.MjData(model)
        area = np.pi * sphere.DISC_RADIUS**2
        rows = [self._rest(model, data, *each) for each in
                zip(touch.points, touch.normals, touch.force, strict=True)]  # fmt: skip
        return np.array(rows) / area

    def _rest(self, model: mujoco.MjModel, data: mujoco.MjData, point: Array, normal: Array,
              force: float) -> Array:  # fmt: skip
        """Forces (n,), N, on the pins with the indenter at rest on a contact point."""
        mujoco.mj_resetData(model, data)
        data.mocap_pos[0] = point + sphere.INDENTER_RADIUS * normal
        mujoco.mju_quatZ2Vec(data.mocap_quat[0], normal)
        data.qfrc_applied[-1] = -force
        for k in range(MAX_STEPS):
            mujoco.mj_step(model, data)
            if k > 20 and np.abs(data.qvel).max() < SETTLED:
                mujoco.mj_forward(model, data)
                return np.array(data.sensordata)
        raise RuntimeError(f"the pins are not at rest after {MAX_STEPS} steps")

    def _xml(self, positions: Array) -> str:
        """The model: pins along the normals, and the indenter on a carrier that is put in place."""
        damping = 2 * np.sqrt(self.stiffness * PIN_MASS)
        pins, sensors = [], []
        size = f"{sphere.DISC_RADIUS} {LENGTH / 2}"
        for k, at in enumerate(positions):
            normal = at / np.linalg.norm(at)
            turn = np.zeros(4)
            mujoco.mju_quatZ2Vec(turn, normal)
            place = " ".join(f"{x:.12g}" for x in at - LENGTH / 2 * normal)
            pins.append(
                f'<body pos="{place}" quat="{" ".join(f"{x:.12g}" for x in turn)}">'
                f'<joint type="slide" axis="0 0 1" stiffness="{self.stiffness}" '
                f'damping="{damping}"/><geom type="cylinder" size="{size}" mass="{PIN_MASS}" '
                f'contype="1" conaffinity="2"/><site name="s{k}" type="sphere" size="0.01"/></body>'
            )
            sensors.append(f'<touch site="s{k}"/>')
        return f"""<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="implicitfast"
            cone="elliptic" tolerance="1e-12"/>
          <default><geom condim="1" solref="0.001 1" solimp="0.99 0.999 0.0001"/></default>
          <worldbody>{"".join(pins)}
            <body mocap="true"><body>
              <joint type="slide" axis="0 0 1" damping="{2 * damping}"/>
              <geom type="sphere" size="{sphere.INDENTER_RADIUS}" mass="{INDENTER_MASS}"
                contype="2" conaffinity="1"/>
            </body></body>
          </worldbody><sensor>{"".join(sensors)}</sensor></mujoco>"""
