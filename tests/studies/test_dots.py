"""The figure of numbers by name."""

import numpy as np
from dots import dots


def test_every_finite_number_is_a_dot_in_its_row():
    rows = {"a": {"joint": 1.0, "centroid": 20.0}, "b": {"joint": float("inf"), "centroid": None}}
    (axes,) = dots(rows, "error", limits={"bound": 1.0}, bands={"a": (0.5, 2.0)}).axes
    drawn = {line.get_label(): np.array(line.get_xydata()).tolist() for line in axes.lines}
    assert drawn["joint"] == [[1.0, 0.0]]
    assert drawn["centroid"] == [[20.0, 0.0]]
    assert drawn["bound"][0][0] == 1.0
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b"]
    assert dots({"a": {"x": 1.0}, "b": {"x": 1.2}}, "y").axes[0].get_xscale() == "linear"
    assert dots({}, "nothing").axes
