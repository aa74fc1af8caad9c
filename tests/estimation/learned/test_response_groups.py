"""Taxels of one module, or of one part of the ids, that respond otherwise than the rest."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.core.errors import ConfigError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.global_parameters import declared_parameters
from meshskin.estimation.joint.departures import MIN_SCORE
from meshskin.estimation.learned.response_groups import response_groups
from meshskin.estimation.localization import CalibratedSkin

from .test_estimate import PEAK, TAXELS, belief, errors, hertz, recording, world

UPPER = np.arange(TAXELS) >= TAXELS // 2
"""Taxels of the second skin."""


def fitted(compression=0.0, size=0.0, scatter=0.0, n=96, slots=None):
    """Taxels whose readings bend by `compression` (n,), in patches larger by `size` (n,), of an
    information of 100 each, and by as much more as `scatter` says."""
    rng = np.random.default_rng(0)
    slopes = [100 * x + 10 * rng.normal(size=n) * (1 + scatter) for x in (compression, size)]
    columns = {"compression": slice(0, 1), "modulus": slice(1, 2)}
    return SimpleNamespace(
        data=SimpleNamespace(
            ids=np.arange(n), parameters=SimpleNamespace(columns=columns),
            belief=SimpleNamespace(module_slots=None if slots is None else np.zeros((slots, 3))),
        ),
        readings=SimpleNamespace(live=np.arange(n)), own=np.zeros((0, n)), jacobian=np.eye(n, 2),
        each=lambda column: (slopes[int(column[1])], np.full(n, 100.0)),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["compression", "size"])
def test_parts_of_the_ids_and_modules_are_told_apart(name):
    ids = np.arange(96)
    found = response_groups(fitted(**{name: 0.5 * (ids >= 60)}))
    assert found.score > MIN_SCORE
    assert found.where == "the taxels from id 60 on"
    assert found.second.tolist() == list(range(60, 96))
    odd = response_groups(fitted(**{name: -0.5 * (ids // 8 == 3)}, slots=8))
    assert odd.score > MIN_SCORE
    assert "number 3," in odd.where
    assert odd.second.tolist() == list(range(24, 32))


def test_every_other_module_is_one_of_two_groups_also_the_last_taxels():
    """The last module has two taxels, too few to be compared."""
    ids = np.arange(86)
    other = ids // 12 % 2 == 1
    found = response_groups(fitted(0.8 * other, n=86))
    assert found.second.tolist() == np.flatnonzero(other).tolist()


@pytest.mark.parametrize("scatter", [0.0, 5.0])
def test_taxels_that_differ_among_themselves_are_no_groups(scatter):
    assert response_groups(fitted(scatter=scatter)).score < MIN_SCORE
    assert response_groups(fitted(n=6, slots=12)).score == 0.0


def test_entries_of_the_global_parameters_by_group():
    one = declared_parameters(("modulus", "exponents", "drag"), {"modulus": 0.5}, 1.0, 1.0)
    two, rows = one.grouped(2)
    assert rows.tolist() == [0, 0, 1, 2, 3, 4, 2, 3, 4]
    assert two.sigma.tolist() == one.sigma[rows].tolist()
    assert len(two.labels) == len(two.sigma)
    shared, first, second = two.columns["drag"], two.columns_of(0), two.columns_of(1)
    assert first["drag"] == second["drag"] == shared
    named = np.array(two.labels)
    assert named[second["modulus"]].tolist() == ["modulus of group 2"]
    assert named[second["exponents"]].tolist() == [
        "exponents of the radius of group 2",
        "exponents of the peak of group 2",
        "exponents of the radius in force errors of group 2",
    ]
    assert named[first["exponents"]].tolist() == [
        "exponents of the radius",
        "exponents of the peak",
        "exponents of the radius in force errors",
    ]
    s = np.arange(len(rows)) * 1.0
    assert two.value("modulus", s, 1) == s[second["modulus"]][0] != two.value("modulus", s)


def saturating(pressure, rng):
    """Taxels of the upper half of the ids saturate."""
    return np.where(UPPER, pressure / (1 + pressure / PEAK), pressure)


def softer(r, force):
    """Patches of the upper half are a fifth wider."""
    return np.where(UPPER[None], hertz(r / 1.2, force), hertz(r, force))


@pytest.fixture(scope="module")
def two():
    """A recording of two amplifiers, and its calibration, which is not told of them."""
    log = recording(*world(read=saturating))
    return log, calibrate(log, belief(contact="learned"))


@pytest.mark.deep
def test_two_responses_in_one_recording_are_found_and_estimated(two, tmp_path):
    log, found = two
    error, stated = errors(found)
    assert 0.8 < stated / error < 1.25
    groups = {tuple(one.taxels): one.reading[-1] / one.level[-1] for one in found.response.each}
    assert groups[tuple(np.flatnonzero(~UPPER))] > 0.85
    assert groups[tuple(np.flatnonzero(UPPER))] < 0.65
    assert not any("another response" in text for text in found.verdict.reasons)
    assert any("of taxels 18 to 36 are" in text for text in found.verdict.reasons)
    found.save(tmp_path / "calibration")
    assert Calibration.load(tmp_path / "calibration").response == found.response
    assert sorted(found.response.metrics()["groups"]) == ["0 to 17", "18 to 36"]
    declared = belief(contact="learned", response_groups=(np.flatnonzero(UPPER),))
    assert errors(calibrate(log, declared))[0] == pytest.approx(error, rel=0.02)


@pytest.mark.slow
def test_skins_of_two_stiffnesses_have_patches_of_two_sizes():
    found = calibrate(recording(*world(softer)), belief(contact="learned"))
    error, stated = errors(found)
    assert 0.8 < stated / error < 1.25
    half = {
        tuple(one.taxels): np.interp(-one.profile.max() / 2, -one.profile, one.distance)
        for one in found.response.each
    }
    wide, narrow = (half[tuple(np.flatnonzero(part))] for part in (UPPER, ~UPPER))
    assert wide / narrow == pytest.approx(1.2, abs=0.05)


@pytest.mark.slow
def test_a_skin_of_two_responses_predicts_the_readings_of_both(two):
    log, found = two

    def misfit(calibration):
        data = gather(log, replace(calibration.belief, response_groups=()))
        skin = CalibratedSkin.of(calibration, data)
        every = np.arange(0, len(data.points), 4)
        off = np.linalg.norm((skin.localize(every) - data.points)[every], axis=1)
        return np.sqrt(np.nanmean(off**2)), skin.log_likelihoods(every)[0].sum()

    one = found.response
    (other,) = one.others
    exchanged = replace(one, taxels=other.taxels, others=(replace(other, taxels=one.taxels),))
    right, wrong = misfit(found), misfit(replace(found, response=exchanged))
    assert right[0] < 0.5 * wrong[0]
    assert right[1] > wrong[1] + 250


def test_groups_that_are_no_lists_of_ids_are_refused():
    for groups, words in (
        ((range(3), [2, 9]), "unique"),
        ((range(500, 510),), "no taxel of the skin"),
        ("1-3", "list of lists"),
        (([0.5],), "whole numbers"),
    ):
        with pytest.raises(ConfigError, match=words):
            belief(response_groups=groups)
    groups = belief(response_groups=(range(30, 900),)).response_groups
    assert [len(ids) for ids in groups] == [870]


def test_groups_that_list_all_taxels_have_the_first_as_their_first():
    ids = belief().taxel_ids
    both = belief(response_groups=(ids[:20], ids[20:]))
    assert len(both.response_groups) == 1
    np.testing.assert_array_equal(both.response_groups[0], ids[20:])
    assert both.with_(noise_sigma=1.0).response_groups[0].tolist() == ids[20:].tolist()
