"""Screening: effects whose own bound says that they cannot matter need no run."""

from __future__ import annotations

from collections.abc import Iterable

from ...effects import Context, Effect

NEGLIGIBLE = 0.05
"""Part of the budget that all effects that are screened out may take together, by their bounds."""


def screened(effects: Iterable[Effect], context: Context, budget: float) -> dict[str, float]:
    """Bounds, m, of the effects that can be left out untried, by name.

    The smallest bounds, as many as sum up to NEGLIGIBLE of the budget. What another effect that is
    not screened out requires is not either.
    """
    effects = tuple(effects)
    out: dict[str, float] = {}
    for effect in sorted(effects, key=lambda e: e.bound(context)):
        bound = effect.bound(context)
        if sum(out.values()) + bound > NEGLIGIBLE * budget:
            break
        out[effect.name] = bound
    while wanted := {n for e in effects if e.name not in out for n in e.requires} & set(out):
        for name in wanted:
            del out[name]
    return out
