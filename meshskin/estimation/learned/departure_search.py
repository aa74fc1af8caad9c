"""The search for what the readings show beyond a learned response: each departure with a high score
is estimated, and stays if it makes the readings more likely.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np

from ...core.arrays import Array
from ..data.global_parameters import (
    ELECTRONICS,
    OWN_DEPARTURES,
    PRIOR_SIGMAS,
    PRIORS,
    nuisance_unit,
)
from ..joint.departures import FILTER_SHARE, MIN_SCORE
from ..joint.leaks import Leaks, crosstalk_score, leaking_pairs
from ..joint.parametrization import Unknowns
from ..joint.pressure import OBSERVED
from ..posegraph.symmetric_blocks import SingularMatrixError
from .deviations import Deviations
from .random_effects import RandomEffects
from .response_groups import response_groups
from .start import with_first_response

MAX_ROUNDS, SAME = 12, 0.05
"""Largest number of choices of the neighbours that crosstalk: places follow, and the choice them;
and the change of their weights from which the choice is the same."""
MIN_READING = 0.15
"""Least fraction of the taxels that read of others for these to have a common share: 0.03 to 0.1
where 3 to 6 of 61 do, which with a common share read of wrong ones, 0.2 and more in boards whose
channels, lines, modules or neighbours crosstalk."""
NOISY = 0.05
"""Noise, relative to the peak, from which forces that are recorded as equal may differ: that of
sensors is 0.5 to 5 %."""
MAX_SHARE = 0.8
"""Largest share of a reading that hysteresis or crosstalk have: others stand behind more."""
MAX_FILTERED = 1.2
"""Largest share of creep: 1 is that of a low-pass filter."""
FILTER_LIFT = 0.05
"""Prior standard deviation of the lift of a low-pass filter, which works all the time."""
MAX_SPENT = 60
"""Steps of Gauss and Newton by departures that do not stay, after which the search ends: one that
takes all its steps is followed by another, as drifts of forces and gains have similar scores. No
world of studies/foreign_worlds.py but "skewed" has more, where the search ends anyway; contact
points scattered by 1 mm on a link had 240 and more, for nothing."""
LEAST_GAIN = 0.5
"""Least increase of the log-likelihood by a departure, relative to what its score promises: 1.4 to
5 where the readings have it, 0 to 0.1 where it stands in for another (studies/foreign_worlds.py
--worlds hysteresis crosstalk; `sphere_noisy` with hysteresis, an indenter offset or scan_order)."""
MAX_LOSS = 10.0
"""Largest fall of the log-likelihood by a departure whose optimum was found: the prior of its
parameters costs less, and none of them above zero would cost nothing."""
GROUPS = "response groups"
"""Name, here, of a response of its own of some of the taxels."""
WIDE_FORCES = 0.2
"""Deviation of ln F to start again from: that of 2 to 4 N recorded as constant, which compression
and scale would go far to explain."""


def first_estimate(effects: RandomEffects) -> RandomEffects:
    """The estimate at its optimum, without departures.

    Forces that are recorded as equal may differ by more than a start with small errors of theirs
    finds.
    """
    begin = effects.unknowns, effects.deviations
    effects = with_first_response(effects)
    converged = effects.converge()
    noise = effects.deviations.noise * effects.data.sigma / effects.data.nominal_peak
    if not converged or (np.ptp(effects.data.force) == 0 and noise > NOISY):
        effects = _likelier_with_wider_forces(effects, *begin)
    return effects


def with_departures(
    effects: RandomEffects, begin: tuple[Unknowns, Deviations], excluded: Collection[str]
) -> tuple[RandomEffects, dict[str, float], bool]:
    """The estimate with what the readings show beyond the response, the scores of other departures,
    but for those that make the readings hardly more likely, and whether the search came to an end:
    it does not where the last one, or two in turn, do not converge, as with a response of another
    kind.

    effects: at its optimum; begin: the unknowns and deviations that it began with; excluded:
    departures that are not estimated, to which all of the electronics join once each of these has
    ended without an optimum or out of reach of its prior. Taxels whose responses differ become two
    groups where the belief declares none.
    """
    unlikely, failed, lost = set[str](), set(excluded), set[str]()
    spent, settled = 0, True
    while True:
        found = scores(effects)
        left = {name: score for name, (score, _) in found.items() if name not in unlikely}
        shown = [name for name in left if left[name] > MIN_SCORE and name not in failed]
        if not shown or spent > MAX_SPENT:
            rest = {name: left[name] for name in left if name != GROUPS}
            return effects, rest, not shown and settled
        name, start, before = shown[0], found[shown[0]][1], effects.stage.done
        extended, first, converged = _with_departure(effects, begin, name, start)
        gain = _objective(effects) - _objective(extended) if converged is not None else -np.inf
        # a small departure gains half its squared score; those of each taxel have a variance's
        least = LEAST_GAIN * (left[name] if name not in OWN_DEPARTURES else MIN_SCORE) ** 2 / 2
        reached = plausible(extended, name)
        if not (reached and gain > least):
            spent += effects.stage.done - before
        if gain < -MAX_LOSS or not reached:
            failed.add(name)
            if name in ELECTRONICS and extended is not effects:
                lost.add(name)
            if len(lost) == len(ELECTRONICS):  # their scores are those of errors of another kind
                excluded = {*excluded, *ELECTRONICS}
            continue
        if gain > least:
            begin, effects = first, extended
            failed = set(excluded)
        else:
            unlikely.add(name)
        if not (converged or settled):  # further departures would not correct it
            rest = {other: left[other] for other in left if other not in (name, GROUPS)}
            return effects, rest, False
        settled = bool(converged)


def _with_departure(
    effects: RandomEffects, begin: tuple[Unknowns, Deviations], name: str, start: Array
) -> tuple[RandomEffects, tuple[Unknowns, Deviations], bool | None]:
    """The estimate with the departure `name`, too, the unknowns and deviations that it began with,
    and whether it converges; None where it is singular.

    From the first start: variances that have absorbed the departure lead to another optimum. Where
    that is above the present one, which is among its values, from there.
    """
    for origin in (begin, (effects.unknowns, effects.deviations)):
        extended = _extended(effects, *origin, name, start)
        if name == "crosstalk":
            leaks = leaking_pairs(effects.fitted())
            if leaks is not None and leaks.reading(len(effects.unknowns.nuisance)) < MIN_READING:
                return effects, begin, None  # single pairs have shares of their own
            extended = _leaking(extended, leaks)
        first, converged = (extended.unknowns, extended.deviations), None
        try:
            converged = extended.converge(partial(plausible, extended, name))
            if converged and name == "crosstalk":
                extended, converged = _within_modules(extended)
            if converged is False or (
                converged and _objective(extended) < _objective(effects) + MAX_LOSS
            ):
                break
        except SingularMatrixError:
            converged = None
    return extended, first, converged


def _within_modules(effects: RandomEffects) -> tuple[RandomEffects, bool]:
    """The estimate with crosstalk between those taxels only that show it, and whether it converges;
    the same where all neighbours do."""
    for _ in range(MAX_ROUNDS):
        share = effects.data.parameters.value("crosstalk", effects.unknowns.s)
        leaks, before = leaking_pairs(effects.fitted(), share), effects.data.leaks
        if leaks is None:
            break
        effects = _leaking(effects, leaks)
        if not effects.converge():
            return effects, False
        if before and leaks.change_from(before) < SAME:
            break
    return effects, True


def _leaking(effects: RandomEffects, leaks: Leaks | None) -> RandomEffects:
    """The estimate with crosstalk of these pairs only."""
    u, d, (readings, pattern) = effects.unknowns, effects.deviations, effects.selected
    data = replace(effects.data, leaks=leaks)
    return RandomEffects(data, readings, u, d, pattern, effects.stage)


def _likelier_with_wider_forces(
    effects: RandomEffects, u: Unknowns, d: Deviations
) -> RandomEffects:
    """The estimate from the unknowns u with WIDE_FORCES if it makes the readings more likely, else
    `effects`, as where it is singular, or its forces have no bounds."""
    d = replace(d, force=max(WIDE_FORCES, d.least_force))
    readings, pattern = effects.selected
    wider = RandomEffects(effects.data, readings, u, d, pattern, effects.stage)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            wider.converge()
            return min(effects, wider, key=_objective)
    except SingularMatrixError:
        return effects


def plausible(extended: RandomEffects, name: str) -> bool:
    """Whether the estimate of the departure `name` is within reach of its prior."""
    parameters = extended.data.parameters
    at = parameters.columns.get(name, slice(0, 0))
    s, sigma = extended.unknowns.s[at], parameters.sigma[at]
    largest = MAX_FILTERED if name == "creep" else MAX_SHARE
    small = name not in ELECTRONICS or bool(np.all(np.abs(s[:1]) <= largest))
    if name == "skew":  # all channels are read within a frame: half of it is the largest deviation
        frame = np.linalg.norm(np.diff(extended.data.points, axis=0), axis=1)
        small = extended.deviations.skew <= float(np.median(frame)) / 2
    return bool(small and np.all(np.abs(s) <= PRIOR_SIGMAS * sigma))


def scores(effects: RandomEffects) -> dict[str, tuple[float, Array]]:
    """`FittedReadings.scores` of the departures that are not estimated, and that of GROUPS."""
    estimated = {*effects.data.parameters.names, *effects.data.parameters.nuisance_names}
    fitted = effects.fitted()
    found = {name: value for name, value in fitted.scores().items() if name not in estimated}
    if "crosstalk" in found:
        score, start = found["crosstalk"]
        found["crosstalk"] = crosstalk_score(fitted, score), start
    if effects.data.parameters.groups == 1:
        groups = response_groups(fitted)
        found = {GROUPS: (groups.score, groups.second), **found}
    rank = {name: score for name, (score, _) in found.items()}
    # a departure that is alike in all taxels can be another one
    for name in rank.keys() & set(OWN_DEPARTURES):
        excess = max(rank[name], 0.0) * (2 * len(fitted.points)) ** 0.5
        rank[name] = (excess / 2) ** 0.5
    return {name: found[name] for name in sorted(found, key=lambda name: -rank[name])}


def _objective(effects: RandomEffects) -> float:
    """Negative logarithm of the likelihood of the readings, up to a constant: by Laplace's method
    over all unknowns, taxel positions with a constant prior density.

    Source: Tierney and Kadane, "Accurate approximations for posterior moments and marginal
    densities", Journal of the American Statistical Association 81 (1986). The last change of the
    variances moves the optimum: the cost there is that here, less the decrease by a Newton step.
    """
    spread = effects.spread[effects.readings.kind == OBSERVED]
    taxel, contact, shared = (np.log(p[p > 0]).sum() for p in effects.prior)
    count = len(effects.unknowns.nuisance), len(effects.unknowns.errors)
    system, _, decrease = effects.system().newton_step()
    volume = system.log_determinant() - count[0] * taxel - count[1] * contact - shared
    return effects.cost() - decrease + float(np.log(spread).sum() + volume / 2)


def _extended(
    effects: RandomEffects, u: Unknowns, deviations: Deviations, name: str, start: Array
) -> RandomEffects:
    """The estimate from the unknowns u and deviations with the departure `name`, too, whose global
    parameters are `start`; none where every taxel has its own. Of GROUPS it is the ids of the
    second one, which starts with the response of the first."""
    p, belief, sigma = effects.data.parameters, effects.data.belief, PRIORS.get(name, 0.0)
    if name == GROUPS:
        belief = replace(belief, response_groups=(start,))
        p, rows = p.grouped(2)
        u = replace(u, s=u.s[rows])
    elif len(start):
        own = np.full(len(start), sigma)
        if name == "creep" and abs(start[0]) >= FILTER_SHARE:
            own[2] = FILTER_LIFT
        p = replace(p, names=(*p.names, name), sigma=np.append(p.sigma, own))
        u = replace(u, s=np.append(u.s, start))
    else:
        sigma *= nuisance_unit(name, effects.data.nominal_peak)
        nuisance = (*p.nuisance_sigma, sigma)
        p = replace(p, nuisance_names=(*p.nuisance_names, name), nuisance_sigma=nuisance)
        u = replace(u, nuisance=np.column_stack([u.nuisance, np.zeros(len(u.nuisance))]))
    data, (readings, pattern) = replace(effects.data, parameters=p, belief=belief), effects.selected
    return RandomEffects(data, readings, u, deviations, pattern, effects.stage)
