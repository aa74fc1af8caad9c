"""The planner: paths of the contact point over a skin, planned for the arm.

Caps of spheres are explored by the paper's parallels about the skin's axis, as far as the arm can
turn them; every other skin by geodesic lanes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import check_real, check_type
from ..core.arrays import Array
from ..core.errors import ContactError, ReachError, warn_left_out
from ..core.progress import Progress
from ..geometry.body import Body
from ..geometry.region import Region
from ..robot.arm import Arm
from ..scene.scene import Scene
from ..scene.settings import Exploration, Law, Loop, Readout
from ..skin.skin import Skin
from .contact_plan import contact_plan
from .lane_plan import lane_plan
from .parallels import is_cap, parallels, reachable_parallels
from .path import Plan

CONTACTS = 70.0
"""Contacts per taxel of `explore` by default: lanes 3.5 mm apart on the paper's sphere."""
TIGHTEST = 0.9
"""Curvature of a hollow, relative to the indenter's, up to which the indenter fits: at 1 it would
touch everywhere at once."""
SITE_SPACING = 5e-3
"""Pitch of the points that stand for a region without taxels, m: that of the paper's skin."""


def plan_exploration(scene: Scene) -> Plan:
    """Plan a scene's exploration by its pattern; `simulate` does so where it is given no path.

    With a carried indenter, a list of contacts. With pattern "auto", parallels on a cap of a
    sphere, geodesic lanes elsewhere and where the arm cannot follow the parallels, or they lead to
    another part of the body. Raises ReachError if the arm cannot follow any path, ContactError if
    the contact model does not hold along parallels.
    """
    exploration = scene.exploration
    if scene.indenter.carried_by is not None:
        return contact_plan(scene, scene.rig)
    if exploration.pattern == "parallels" or (exploration.pattern == "auto" and is_cap(scene)):
        curvature = scene.body.closest(scene.skin.positions).curvature
        for k in np.flatnonzero(scene.invalid_reasons(curvature) != "")[:1]:
            scene.indentation.patch(scene.model.name, curvature[k])  # raises
        try:
            arm = scene.rig.arm
            path = reachable_parallels(scene) if arm else parallels(scene, 0.0, scene.loop.dt)
            return Plan(path, exploration.lane_spacing)
        except ReachError:
            if exploration.pattern == "parallels":
                raise
    return lane_plan(scene, scene.rig)


def explore(
    body: Body,
    skin_region: Skin | Region | str,
    *,
    arm: Arm | None = None,
    mount: Array | None = None,
    indenter: Indenter | None = None,
    material: Material | None = None,
    force: float = 3.0,
    exploration: Exploration | None = None,
    dt: float = 1e-3,
    frame: float = 0.01,
    mode: str = "arm",
    progress: Progress | None = None,
) -> Plan:
    """Plan how the contact point passes over a skin, or over a region of a body.

    The plan consists of geodesic lanes, spun about the normal as the joint limits require, with a
    break where the arm must take another posture. `simulate(scene, path=plan.path)` follows it in a
    scene with the same body, arm, mount, indenter and step.

    skin_region: a skin, a region, or the name of a patch; a region is covered by points 5 mm apart.
    arm, mount (T_tip_body, (4, 4)), indenter, material: by default those of `Scene(body, skin)`.
    force, N: contact force, which with the material gives the contact patch, hence the depth and,
    with `exploration.contacts`, the spacing of the lanes. dt, s: period of the path; frame, s: of
    the readings. mode: "arm", or "quasi_static" for a body that moves without an arm.
    progress("explore", done, total): called between the steps of planning lanes. Warns where taxels
    are not covered (LeftOutWarning). Raises ReachError where nothing can be explored, SkinError for
    a region too small, ContactError where no contact model holds, ConfigError for a value out of
    range.
    """
    for name, value, unit in (("force", force, "N"), ("dt", dt, "s"), ("frame", frame, "s")):
        check_real(f"{name} of an exploration", value, unit, above=0.0)
    check_type(Body, body, "what is explored")
    skin = skin_region
    if not isinstance(skin, Skin):
        skin = Skin.cover(body, spacing=SITE_SPACING, region=skin)
    parts: dict[str, Any] = {"arm": arm, "mount": mount, "indenter": indenter, "material": material}
    scene = Scene(
        body=body,
        skin=skin,
        law=Law(force_reference=force),
        exploration=exploration or Exploration(contacts=CONTACTS),
        loop=Loop(dt=dt, mode=mode),
        readout=Readout(rate=1.0 / frame),
        **{name: part for name, part in parts.items() if part is not None},
    )
    try:
        rig = scene.rig_of(scene.patch, scene.invalid_reasons)
    except ContactError:  # a wide contact: beyond the models that a scene is simulated with
        rig = scene.rig_of(scene.indentation.patch("field", _typical_curvature(scene)))
    carried = scene.indenter.carried_by is not None
    plan = contact_plan(scene, rig) if carried else lane_plan(scene, rig, progress)
    warn_left_out("covered", plan.unreachable.values(), len(skin))
    return plan


def _typical_curvature(scene: Scene) -> Array:
    """The principal curvatures (2,), 1/m, of the taxel in the middle of those that the indenter
    fits; the plan leaves the others out.
    """
    curvature = scene.body.closest(scene.skin.positions).curvature
    fitting = curvature[curvature[:, 1] * scene.indenter.radius > -TIGHTEST]
    curvature = fitting if len(fitting) else curvature
    mean = curvature.mean(axis=1)
    return np.asarray(curvature[np.argmin(np.abs(mean - np.median(mean)))])
