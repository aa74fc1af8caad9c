"""Accuracy against time: numerical parts of the right order, a front that nothing beats."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli
from meshskin.core.errors import UnknownNameError
from meshskin.geometry.region import Cap
from meshskin.study.sensitivity.cost import Row, Setting, cost, front, pilot_of
from meshskin.study.sensitivity.knobs import single_changes


@pytest.fixture(scope="module")
def scene():
    """A small skin on the paper's sphere, with its noise, read at 20 Hz."""
    whole = ms.Scene.load("sphere_noisy")
    region = Cap(direction=(0.0, 0.0, -1.0))
    skin = ms.Skin.cover(whole.body, spacing=6e-3, count=14, region=region)
    return whole.with_(skin=skin, readout=replace(whole.readout, rate=20.0))


@pytest.fixture(scope="module")
def costs(scene):
    """One of its knobs."""
    stages = []
    found = cost(
        scene, knobs=("dt",), finer=2, targets=(0.1,), progress=lambda *told: stages.append(told)
    )
    assert stages[:4] == [("reference", done, 3) for done in range(4)]
    assert [told[1] for told in stages[4:]] == list(range(len(stages) - 4))
    assert stages[-1] == ("cost", stages[-1][1], stages[-1][1])
    return found


@pytest.fixture(scope="module")
def costs_of_two(scene):
    """Two of its knobs."""
    return cost(scene, knobs=("dt", "rate"), targets=(0.1,))


def rows(costs, knob):
    return [row for row in costs.rows if row.knob == knob and not row.failure]


@pytest.mark.slow
def test_second_routes_confirm_the_reference(costs):
    routes = {route.name.partition(":")[0]: route for route in costs.routes}
    assert routes["surface"].mean_mm < 1e-5
    assert 0 < routes["integration"].largest_mm < 1e-4
    # another profile at the patch's rim, by the elements' size: 0.1 % of the patch's radius
    assert 0 < routes["contact"].mean_mm < 0.005


@pytest.mark.deep
def test_the_numerical_part_is_of_the_integrators_order(costs):
    """Semi-implicit Euler: twice the step, twice the shift, and far below the noise."""
    own = costs.rows[0]
    by_dt = {row.setting.dt: row.numerical_mm for row in rows(costs, "dt")}
    assert by_dt[0.5e-3] / own.numerical_mm == pytest.approx(0.5, rel=0.1)
    assert by_dt[2e-3] / own.numerical_mm == pytest.approx(2.0, rel=0.1)
    assert own.numerical_mm < 0.1 * own.error_mm


def test_errors_are_near_the_bound(costs):
    for row in [costs.rows[0], *rows(costs, "dt")]:
        assert row.error_mm == pytest.approx(row.bound_mm, rel=0.6)


@pytest.mark.slow
def test_errors_fall_with_the_readings(costs_of_two):
    whole = costs_of_two
    for row in [whole.rows[0], *rows(whole, "rate")]:
        assert row.error_mm == pytest.approx(row.bound_mm, rel=0.6)
        expected = whole.rows[0].bound_mm * np.sqrt(whole.base.rate / row.setting.rate)
        assert row.bound_mm == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_three_circles_are_far_less_accurate(scene):
    found = cost(scene, knobs=("method",), targets=(0.1,))
    by_method = {row.setting.method: row.error_mm for row in rows(found, "method")}
    assert by_method["three_circles"] > 4 * found.rows[0].error_mm


def test_a_setting_that_fails_is_a_row_with_the_reason(costs):
    failed = [row for row in costs.rows if row.failure]
    assert [1e3 * row.setting.dt for row in failed] == [5.0]
    assert "too long" in failed[0].failure
    assert failed[0] not in costs.whole


def test_no_row_beats_the_front(costs):
    for one in costs.front:
        for other in costs.whole:
            assert not (other.time < one.time and other.total_mm < one.total_mm)
    assert costs.cheapest(0.1) in costs.front
    assert costs.cheapest(0.1).time <= costs.rows[0].time
    assert costs.cheapest(1e-9) is None


def test_front_of_known_points():
    made = [row(2.0, 1.0), row(1.0, 3.0), row(3.0, 2.0), row(4.0, 0.5)]
    assert [r.time for r in front(made)] == [1.0, 2.0, 4.0]


def row(seconds, error):
    """A row of given time and error."""
    setting = Setting(None, 4, "hertz", 1e-3, "rk4", 3e-3, 100.0)
    return Row("scene", setting, error, 0.0, seconds={"simulate": seconds})


def test_records_are_plain(costs):
    records = costs.records()
    assert len(records) == len(costs.rows)
    assert json.loads(json.dumps(records))[0]["change"] == "the scene as it is"
    assert sum(r["front"] for r in records) == len(costs.front)


def test_a_notebook_shows_the_front(costs):
    assert costs.facts()["its own"].startswith(f"{costs.own.total_mm:.3g} mm in ")
    assert "data:image/png" in costs._repr_html_()
    errors = [row.error_mm for row in costs.rows]
    np.testing.assert_array_equal(costs.to_pandas()["error_mm"], errors)


@pytest.mark.slow
def test_predictions_reproduce_the_measurements(costs_of_two):
    single = [row for row in costs_of_two.rows if row.knob in ("scene", "dt", "rate")]
    measured = pilot_of(single)
    predictions = {p.setting: p for p in measured.predictions()}
    for row in [r for r in single if r.setting in predictions]:
        found = predictions[row.setting]
        # the mean of 14 errors scatters by 15 %, and every rate has noise of its own
        assert found.error_mm == pytest.approx(row.error_mm, rel=0.4)
        assert found.numerical_mm == pytest.approx(row.numerical_mm, rel=1e-6)
        assert found.processor_seconds == pytest.approx(row.time, rel=0.5)
    assert {row.knob for row in single if row.setting in predictions} >= {"scene", "rate", "dt"}
    assert replace(costs_of_two.base, dt=0.25e-3) not in predictions


def test_single_changes_change_one_knob_at_a_time(scene):
    base = Setting.of(scene)
    for knob, setting in single_changes(base, scene):
        changed = [f for f in Setting.__dataclass_fields__
                   if getattr(setting, f) != getattr(base, f)]  # fmt: skip
        assert len(changed) <= (2 if knob == "integrator" else 1)


def test_a_loaded_mesh_has_no_other_faces_and_a_body_without_arm_no_integrator(scene):
    found = scene.with_(
        body=replace(scene.body, exact=None), loop=replace(scene.loop, mode="quasi_static")
    )
    base = Setting.of(found)
    assert base.faces is None
    knobs = {knob for knob, _ in single_changes(base, found)}
    assert {"faces", "integrator"}.isdisjoint(knobs)
    assert {"dt", "lanes", "method"} <= knobs
    assert base.body(found.body) is found.body


def test_the_command_writes_page_figure_and_settings(costs, tmp_path):
    from meshskin.cli.cost import summary, write

    write(costs, tmp_path)
    page = (tmp_path / "cost.html").read_text()
    for words in ("Fastest settings for an accuracy", "exact primitive", "the scene as it is"):
        assert words in page
    record = json.loads((tmp_path / "cost.json").read_text())
    assert len(record["settings"]) == len(costs.rows)
    assert record["settings"][0]["error_mm"] == costs.rows[0].error_mm
    assert (tmp_path / "figures" / "work_precision.png").stat().st_size > 10_000
    lines = summary(costs).splitlines()
    assert lines[0].startswith("sphere_noisy: ")
    assert [line.split()[0] for line in lines[2:7]] == ["1", "0.3", "0.1", "0.03", "0.01"]


def test_a_setting_does_not_move_the_skin(scene):
    coarse = replace(Setting.of(scene), faces=1280)
    made = coarse.scene(scene, coarse.body(scene.body))
    assert len(made.body.mesh.faces) == 1280
    assert made.skin is scene.skin


def test_an_unknown_knob(scene):
    with pytest.raises(UnknownNameError, match="did you mean rate"):
        cost(scene, knobs=("rat",))


def test_the_command_resolves_a_budget_first(scene, costs, tmp_path, monkeypatch):
    """Of a scene whose effects a budget chooses, what it calls for is measured, as it would run."""
    seen = []
    monkeypatch.setattr(ms.Scene, "load", lambda name: scene.with_(budget=1.0, candidates=()))
    chosen = scene.with_(effects=(), budget=None)
    monkeypatch.setattr(
        "meshskin.study.sensitivity.budget.budget",
        lambda of, **_: seen.append(of) or SimpleNamespace(scene=chosen),
    )
    monkeypatch.setattr(
        "meshskin.study.sensitivity.cost.cost", lambda of, **_: seen.append(of) or costs
    )
    assert cli.main(["cost", "any", "--out", str(tmp_path), "--quiet"]) == 0
    assert seen[0].budget == 1.0
    assert seen[1] is chosen
