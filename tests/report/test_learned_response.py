"""What a report shows of a learned response: units, curves, bands, and no missing modulus."""

import json
from dataclasses import replace

import matplotlib.text
import numpy as np
import pytest

from meshskin.estimation.result import LearnedResponse
from meshskin.report import learned_response, page


def response(unit: float) -> LearnedResponse:
    """A made-up one, whose profile is half the model's, in readings of up to 200 units."""
    distance, level = np.linspace(0, 8e-3, 9), np.linspace(0, 200, 5)
    model = 200 * np.exp(-((distance / 3e-3) ** 2))
    return LearnedResponse(
        distance=distance, profile=model / 2, profile_sigma=np.full(9, 4.0), model=model,
        level=level, reading=level / (1 + level / 400), reading_sigma=0.05 * level,
        contact_scatter=0.31e-3, contact_correlation=0.1, force_scatter=0.042, noise=3.2,
        noise_relative=0.013, unit=unit,
    )  # fmt: skip


@pytest.mark.parametrize(("unit", "name", "scale"), [(1.0, "kPa", 1e-3), (5e-3, "counts", 1.0)])
def test_the_figure_states_its_unit_and_draws_what_was_learned(unit, name, scale):
    found = response(unit)
    figure = learned_response.figure(found)
    profile, curve = figure.axes
    assert profile.get_xlabel() == "distance from the contact point (mm)"
    labels = [profile.get_ylabel(), curve.get_xlabel(), curve.get_ylabel()]
    assert all(label.endswith(f"({name})") for label in labels)
    lines = {line.get_label(): line.get_xydata() for line in profile.lines}
    np.testing.assert_allclose(lines["learned"][:, 0], 1e3 * found.distance)
    np.testing.assert_allclose(lines["learned"][:, 1], scale * found.profile)
    drawn = lines["contact model"][:, 1]  # as high as what was learned
    np.testing.assert_allclose(drawn, scale * found.model * found.profile.max() / found.model.max())
    lines = {line.get_label(): line.get_xydata() for line in curve.lines}
    np.testing.assert_allclose(
        lines["learned"], scale * np.column_stack([found.level, found.reading])
    )
    (band,) = profile.collections
    corners = band.get_paths()[0].vertices
    assert corners[:, 1].max() == pytest.approx(scale * (100 + 2 * 4.0))
    (band,) = curve.collections
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(scale * (400 / 3 + 20.0))
    assert any("2 sigma" in t.get_text() for t in figure.findobj(matplotlib.text.Text))


def test_a_profile_below_zero_has_a_line_at_zero():
    found = response(1.0)
    below = replace(found, profile=found.profile - 1.0)
    for one, drawn in ((found, False), (below, True)):
        lines = learned_response.figure(one).axes[0].lines
        assert any(np.array_equal(line.get_ydata(), [0.0, 0.0]) for line in lines) == drawn


def test_each_group_of_taxels_has_curves_of_its_own():
    one = replace(response(5e-3), taxels=np.arange(12))
    other = replace(one, taxels=np.r_[12:24, 40], profile=one.profile / 4, reading=one.reading / 2)
    figure = learned_response.figure(replace(one, others=(other,)))
    for axes, name in zip(figure.axes, ("profile", "reading"), strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        for group, words in ((one, "taxels 0 to 11"), (other, "taxels 12 to 23, 40")):
            np.testing.assert_allclose(lines[words].get_ydata(), getattr(group, name))
        colors = {lines[words].get_color() for words in lines if words.startswith("taxels")}
        assert len(colors) == 2
    dashed = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    assert [line.get_ydata().max() for line in dashed] == [100.0, 25.0]
    words = " ".join(replace(one, others=(other,)).describe())
    assert "2 groups of taxels have responses of their own: 0 to 11; 12 to 23, 40" in words


def test_errors_over_edges_are_described_where_contacts_tell_them():
    """1 is where they begin, and stays where no contact is over an edge."""
    words = "readings over edges of the body err by 0.23 of the peak"
    told = [replace(response(5e-3), edge_error=value) for value in (0.234, 1.0, 0.0)]
    assert [words in " ".join(one.describe()) for one in told] == [True, False, False]
    assert [one.metrics()["edge_error"] for one in told] == [0.234, 1.0, 0.0]
    assert "over edges" not in " ".join(told[1].describe())


@pytest.mark.deep
def test_a_page_says_what_was_learned(case, tmp_path):
    c = replace(case.calibration(), response=response(5e-3), modulus=None, modulus_sigma=None)
    c = replace(c, unknowns={"modulus": (0.05, 0.02), "modulus of group 2": (0.3, 0.01)})
    metrics = {"modulus_pa": None, "response": c.response.metrics()}
    files = page.report(tmp_path / "report.html", calibration=c, body=None, metrics=metrics)
    html = files[0].read_text(encoding="utf-8")
    assert "Contact points scatter by 0.31 mm along each tangent" in html
    assert "Forces scatter by 4.2 %" in html
    assert "Readings have noise of 3.2 counts and 1.3 % of the level" in html
    assert html.count("Learned profile beside the contact model") == 1
    assert (tmp_path / "figures" / "response.svg").exists()
    assert "None" not in html.split("<script")[0]
    assert "Effective modulus" not in html
    assert "<td>patch stiffness</td>" in html
    assert "1.051 ± 0.021" in html
    assert "<td>patch stiffness of group 2</td>" in html
    assert "1.35 ± 0.013" in html


@pytest.mark.deep
def test_a_page_of_the_contact_model_s_response_has_no_such_section(case, tmp_path):
    files = page.report(tmp_path / "report.html", calibration=case.calibration(), body=None)
    assert learned_response.TITLE not in files[0].read_text(encoding="utf-8")
    assert not (tmp_path / "figures" / "response.svg").exists()


def test_a_page_has_the_unknowns_in_readable_units(case, tmp_path):
    unknowns = {"clock_offset": (0.037, 2e-4), "joint_offset elbow": (-0.01, 1e-3)}
    c = replace(case.calibration(), unknowns=unknowns)
    metrics = {"unknowns": {name: list(value) for name, value in unknowns.items()}}
    files = page.report(tmp_path / "report.html", calibration=c, body=None, metrics=metrics)
    html = files[0].read_text(encoding="utf-8")
    assert "37 ± 0.2 ms" in html
    assert "0.573 ± 0.057 degrees" in html
    assert "unknowns." not in html


@pytest.mark.parametrize("ids", [[], [3, 2**40]])
def test_ids_of_a_group_are_integers_when_they_are_read_back(ids):
    written = replace(response(1.0), taxels=np.array(ids, dtype=int))
    read = LearnedResponse.from_values(json.loads(json.dumps(written.values())))
    assert read.taxels.dtype == int
    assert read.taxels.tolist() == ids
