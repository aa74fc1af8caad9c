"""What an indenter reaches: the part of a body's surface that it can be pressed on.

Points spread evenly over the visible surface are tested as the planner tests the samples of its
lanes: the indenter fits, no edge is within the contact patch, a contact model holds, and a
straight path leads there from outside. An arm may reach less.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from ..contact.material import Material
from ..contact.problem import MAX_WIDTH
from ..core.arguments import check_real, check_type
from ..core.arrays import Array
from ..core.errors import ConfigError, ContactError, MeshError
from ..core.progress import Progress, Stage
from ..core.se3 import orthonormal_basis, transform
from ..geometry.body import Body
from ..geometry.mesh.rays import exposure
from ..scene.scene import Scene
from ..scene.settings import Law, Loop
from ..skin.skin import Skin
from .pressing import lighter_rigs, pressed_lighter

POINTS = 1500
"""Points on the visible surface: a share of a half is known to 1.3 %."""
GENTLE_WIDTH = 0.45
"""a/R on a plane under the force that replaces one under which no contact model holds there: below
MAX_WIDTH, so that it holds in shallow hollows, too."""
BRIDGED = 0.5e-3
"""Distance from a point to the skin's underside, m, from which the skin bridges it."""
NEARLY = 0.9
"""Share, relative to the largest, that is as good as it."""

SIZE = attrgetter("radius", "force")
"""What a contact is larger or smaller by."""
UNDER_SKIN = "under the skin: it bridges the place"
TOO_WIDE = "no contact model holds anywhere"
OR_LESS = " or less"
"""A half to an eighth of the force, where the whole is refused."""


@dataclass(frozen=True)
class Reach:
    """What an indenter reaches of the visible surface of a body."""

    radius: float
    """Radius of the indenter, m."""
    force: float
    """Contact force, N: as asked, or less where its patch would be too wide for a contact model."""
    share: float
    """Part of the visible surface on which a contact is possible with the force, a half to an
    eighth of it."""
    reasons: Mapping[str, float] = field(default_factory=dict)
    """Part of the visible surface by the reason why no contact is possible, the largest first."""

    @classmethod
    def of(cls, radius: float, force: float, reasons: Array) -> Reach:
        """From the reason (n,) at evenly spread points, "" where a contact is possible."""
        counts = Counter(reasons[reasons != ""].tolist()).most_common()
        parts = {why: count / len(reasons) for why, count in counts}
        return cls(radius, force, float(np.mean(reasons == "")), parts)

    def __str__(self) -> str:
        forces = f"{self.force:.2g} N{OR_LESS}"
        head = f"{1e3 * self.radius:g} mm reaches {self.share:.0%} with {forces}"
        kinds: dict[str, float] = {}
        for why, part in self.reasons.items():
            kind = why.split(":")[0]
            kinds[kind] = kinds.get(kind, 0.0) + part
        rest = (
            f"{kind} {f'{part:.0%}' if part >= 0.005 else '<1%'}" for kind, part in kinds.items()
        )
        return f"{head} (not reached: {', '.join(rest)})" if kinds else head


def reach(
    body: Body,
    radii: float | Sequence[float],
    *,
    force: float = 3.0,
    material: Material | None = None,
    skin: float | None = None,
    progress: Progress | None = None,
) -> tuple[Reach, ...]:
    """What indenters with `radii`, m, one or several, reach of the visible surface of a body.

    A point of the surface is visible if a straight line leads away from it. force, N, is reduced
    for an indenter whose contact patch would be too wide on a plane. material: by default that of a
    scene. skin: thickness, m, of a skin whose surface is pressed in place of the body's,
    `body.skinned(skin, 1.5 * radius)`; places that it bridges are not reached.
    progress("reach", done, total): called after each radius. Raises ConfigError
    for a value out of range, MeshError for a skin that cannot be made.
    """
    check_type(Body, body, "what an indenter reaches")
    check_real("force of a contact", force, "N", above=0.0)
    tried = np.atleast_1d(radii).tolist()
    if not tried:
        raise ConfigError("no radius of an indenter was given", remedy="give one or more, in m")
    for radius in tried:
        check_real("radius of an indenter", radius, "m", above=0.0)
    points, normals = even_points(body)
    seen = visible(body, points, normals)
    if not seen.any():
        raise MeshError("no point of the surface is visible", remedy="check the mesh")
    points, found = points[seen], []
    stage = Stage(progress, "reach", len(tried))
    for radius in tried:
        surface = body if skin is None else body.skinned(skin, 1.5 * radius)
        hit = surface.closest(points)
        poses = transform(orthonormal_basis(hit.normal), hit.point)
        scene = Scene(
            body=surface,
            skin=Skin(poses, np.arange(len(points))),
            material=Material() if material is None else material,
            law=Law(force_reference=force),
            loop=Loop(mode="quasi_static"),
        )
        used, reasons = contact_reasons(scene, radius)
        if skin is not None:
            reasons[np.abs(hit.distance) > skin + BRIDGED] = UNDER_SKIN
        found.append(Reach.of(radius, used, reasons))
        stage.step()
    return tuple(found)


def contact_reasons(scene: Scene, radius: float, force: float | None = None) -> tuple[float, Array]:
    """The force, N, of an indenter of `radius`, m, and the reason (n,) at each taxel of a scene why
    no contact is possible, at this force or a lighter one, "" where one is possible. The arm is not
    considered.

    force, N: the scene's if None; less where its patch would be too wide on a plane.
    """
    wanted = scene.law.force_reference if force is None else force
    used = possible_force(radius, wanted, scene.material)
    other = scene.with_(
        indenter=replace(scene.indenter, radius=radius),
        law=replace(scene.law, force_reference=used),
    )
    try:
        rig = other.rig
    except ContactError:
        return used, np.full(len(scene.skin), TOO_WIDE, dtype=object)
    points, normals = scene.skin.positions, scene.skin.normals
    reason = rig.contact_reasons(points, normals)
    for _, lighter in lighter_rigs(other):
        pressed_lighter(lighter, points, normals, reason)
    return used, reason


def other_contacts(scene: Scene) -> tuple[Reach, ...]:
    """What the scene's contact, those with a half and a quarter of its force, and indenters of a
    half and a quarter of its radius, reach of the taxels of a scene."""
    radius, force = scene.indenter.radius, scene.law.force_reference
    pairs = [(radius, force / k) for k in (1, 2, 4)] + [(radius / k, force) for k in (2, 4)]
    return tuple(Reach.of(r, *contact_reasons(scene, r, f)) for r, f in pairs)


def possible_force(radius: float, force: float, material: Material) -> float:
    """The force, N, or that of a patch of GENTLE_WIDTH on a plane where its own is too wide."""
    unit = 4.0 / 3.0 * material.effective_modulus * radius**2  # F = 4/3 E* a^3 / R
    return force if force <= MAX_WIDTH**3 * unit else GENTLE_WIDTH**3 * unit


def recommended(found: Sequence[Reach]) -> Reach:
    """The largest indenter that reaches nearly as much as the best one: NEARLY; of equal ones that
    with the largest force.

    A larger one has a wider patch, which presses more taxels at once.
    """
    best = max(one.share for one in found)
    return max((one for one in found if one.share >= NEARLY * best), key=SIZE)


def recommendation(found: Sequence[Reach]) -> str:
    """The recommended one of several indenters, and what it and the largest other one reach."""
    best = recommended(found)
    if best.share == 0.0:
        return "none reaches anything"
    share = f"{best.share:.0%}"
    text = f"{1e3 * best.radius:g} mm reaches {share}"
    other = max((one for one in found if one is not best), key=SIZE)
    setting = f"{1e3 * other.radius:g} mm"
    if other.radius == best.radius:
        text += f" with {best.force:.2g} N{OR_LESS}"
        setting = f"{other.force:.2g} N{OR_LESS}"
    if f"{other.share:.0%}" == share:
        return f"{text}, as with {setting}"
    return f"{text} instead of {other.share:.0%} with {setting}"


def even_points(body: Body) -> tuple[Array, Array]:
    """Points (n, 3), m, spread by area over a body, and its outward normals (n, 3) there."""
    import trimesh

    points = trimesh.sample.sample_surface(body.mesh, POINTS, seed=1)[0]
    hit = body.closest(np.asarray(points))
    return hit.point, hit.normal


def visible(body: Body, points: Array, normals: Array) -> NDArray[np.bool_]:
    """Whether (n,) a straight line in front of a point (n, 3) leads away from the body."""
    return exposure(body.mesh.vertices, body.mesh.faces, points, normals) > 0.0
