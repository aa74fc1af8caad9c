"""Permutations of module or taxel numbers in words."""

from __future__ import annotations

from . import slots

MIN_TAXELS = 20
"""Number of permuted taxels from which on they are described by modules, if they moved with them:
two modules."""


def words(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    """Exchanges, cycles and chains of a permutation of units ("module" or "taxel") from A to B.

    Taxels that moved with their modules are described by modules, and by permutations of slots.
    """
    if unit == "taxel" and len(permutation) >= MIN_TAXELS:
        return _by_modules(permutation) or _by_units(permutation, unit)
    return _by_units(permutation, unit)


def _by_modules(permutation: dict[int, int]) -> tuple[str, ...]:
    """Sentences by modules; none if the taxels of a module did not move together."""
    slot_maps: dict[int, dict[int, int]] = {}
    targets: dict[int, set[int]] = {}
    for before, after in sorted(permutation.items()):
        module, slot = divmod(before, slots.PER_MODULE)
        targets.setdefault(module, set()).add(after // slots.PER_MODULE)
        slot_maps.setdefault(module, {})[slot] = after % slots.PER_MODULE
    if any(slot in slots.THERMAL for m in slot_maps.values() for slot in (*m, *m.values())):
        return ()  # taxels without modules
    if any(len(found) > 1 for found in targets.values()):
        return ()
    target = {module: found.pop() for module, found in targets.items()}
    patterns: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for module, slot_map in slot_maps.items():
        same = {} if target[module] != module else {s: s for s in slots.TAXELS if s not in slot_map}
        patterns.setdefault(tuple(sorted((same | slot_map).items())), []).append(module)
    if len(patterns) > 0.5 * len(slot_maps):
        return ()
    moved = {module: number for module, number in target.items() if module != number}
    sentences = list(_by_units(moved, "module")) if moved else []
    for pattern, modules in patterns.items():
        if all(one == two for one, two in pattern):
            continue
        from_slots, to_slots = (" ".join(map(str, end)) for end in zip(*pattern, strict=True))
        where = ", ".join(map(str, modules))
        sentences.append(f"slots {from_slots} are slots {to_slots} of B in modules {where} of A")
    return tuple(sentences)


def _by_units(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    """Sentences by units: a common shift, or exchanges, cycles and chains."""
    shifts = {after - before for before, after in permutation.items()}
    if len(permutation) > 2 and len(shifts) == 1:
        shift = shifts.pop()
        return (
            f"{unit} numbers of B are those of A {'plus' if shift > 0 else 'minus'} {abs(shift)}",
        )
    remaining, sentences = dict(permutation), []
    targets = set(remaining.values())
    for number in sorted(remaining, key=lambda n: (n in targets, n)):  # chains first
        if number not in remaining:
            continue
        chain = [number]
        while chain[-1] in remaining:
            chain.append(remaining.pop(chain[-1]))
        closed = chain[0] == chain[-1]
        if len(chain) == 2:
            sentences.append(f"{unit} {chain[0]} of A is {unit} {chain[1]} of B")
        elif closed and len(chain) == 3:
            sentences.append(f"{unit}s {chain[0]} and {chain[1]} exchanged")
        else:
            done = "permuted" if closed else "renumbered"
            sentences.append(f"{unit}s {done}: {' -> '.join(map(str, chain))} (A -> B)")
    return tuple(sentences)
