"""A permutation of modules or taxels in words."""

from __future__ import annotations

from . import slots

MANY = 20
"""taxels from which it is looked whether whole modules were renumbered, and their slots"""


def words(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    """Exchanges, cycles and chains of a permutation of units ("module" or "taxel") from A to B.

    Taxels that went with their modules, whose slots were renumbered in a few ways, are told so.
    """
    if unit == "taxel" and len(permutation) >= MANY:
        return _by_modules(permutation) or _each(permutation, unit)
    return _each(permutation, unit)


def _by_modules(permutation: dict[int, int]) -> tuple[str, ...]:
    """Sentences by modules; none where taxels of one module went to several, or in many ways."""
    ways: dict[int, dict[int, int]] = {}
    homes: dict[int, set[int]] = {}
    for here, there in sorted(permutation.items()):
        module, slot = divmod(here, slots.PER_MODULE)
        homes.setdefault(module, set()).add(there // slots.PER_MODULE)
        ways.setdefault(module, {})[slot] = there % slots.PER_MODULE
    if any(slot in slots.THERMAL for way in ways.values() for slot in (*way, *way.values())):
        return ()  # taxels without modules
    if any(len(home) > 1 for home in homes.values()):
        return ()
    home = {module: found.pop() for module, found in homes.items()}
    alike: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for module, way in ways.items():
        stayed = {} if home[module] != module else {s: s for s in slots.TAXELS if s not in way}
        alike.setdefault(tuple(sorted((stayed | way).items())), []).append(module)
    if len(alike) > 0.5 * len(ways):
        return ()
    moved = {module: there for module, there in home.items() if module != there}
    sentences = list(_each(moved, "module")) if moved else []
    for pattern, modules in alike.items():
        if all(one == two for one, two in pattern):
            continue
        before, after = (" ".join(map(str, end)) for end in zip(*pattern, strict=True))
        where = ", ".join(map(str, modules))
        sentences.append(f"slots {before} are slots {after} of B in modules {where} of A")
    return tuple(sentences)


def _each(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    shifts = {there - here for here, there in permutation.items()}
    if len(permutation) > 2 and len(shifts) == 1:
        shift = shifts.pop()
        return (
            f"{unit} numbers of B are those of A {'plus' if shift > 0 else 'minus'} {abs(shift)}",
        )
    left, sentences = dict(permutation), []
    targets = set(left.values())
    for here in sorted(left, key=lambda number: (number in targets, number)):  # chains first
        if here not in left:
            continue
        chain = [here]
        while chain[-1] in left:
            chain.append(left.pop(chain[-1]))
        closed = chain[0] == chain[-1]
        if len(chain) == 2:
            sentences.append(f"{unit} {chain[0]} of A is {unit} {chain[1]} of B")
        elif closed and len(chain) == 3:
            sentences.append(f"{unit}s {chain[0]} and {chain[1]} exchanged")
        else:
            done = "permuted" if closed else "renumbered"
            sentences.append(f"{unit}s {done}: {' -> '.join(map(str, chain))} (A -> B)")
    return tuple(sentences)
