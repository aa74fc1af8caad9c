"""What everything is: the effects that a scene may need."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ... import effects
from ...core.errors import MeshskinError
from ...effects import Effect

if TYPE_CHECKING:
    from ...scene.scene import Scene


def candidates(scene: Scene, seed: int = 0) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """The effects that a budget chooses from, in order, and why each other one is not among them.

    Those that the scene has on; then its `candidates`, or, if it names none, all that are
    registered, at their defaults. Of effects that exclude each other the first one is taken; one
    that cannot be built in the scene (encoders without joints), or lacks what it requires, is not.
    """
    context, taken, refused = scene.context(seed), list(scene.effects), {}
    listed = effects.registered() if scene.candidates is None else scene.candidates
    for effect in listed:
        names = {e.name for e in taken}
        if effect.name in names:
            continue
        rival = next((e.name for e in taken if _exclude(e, effect)), None)
        if rival is not None:
            refused[effect.name] = f"excluded by {rival}"
            continue
        try:
            effect.build(context)
        except MeshskinError as error:
            refused[effect.name] = str(error)
            continue
        taken.append(effect)
    while lacking := [e for e in taken if not set(e.requires) <= {other.name for other in taken}]:
        for effect in lacking:
            taken.remove(effect)
            refused[effect.name] = f"requires {', '.join(effect.requires)}"
    return effects.ordered(taken), refused


def _exclude(one: Effect, other: Effect) -> bool:
    return other.name in one.excludes or one.name in other.excludes
