"""The study of consistency with few seeds: all quantities there, none far from one."""

import importlib.util
import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "studies" / "consistency.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("consistency_study", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def wide(row):
    """Whether the mean lies within twice the half-width of its 95 % band."""
    return 2 * row["low"] - 1 < row["nees"] < 2 * row["high"] - 1


def test_few_seeds(study, tmp_path, capsys):
    found = study.main(["--seeds", "3", "--json", str(tmp_path / "x.json")])
    assert json.loads((tmp_path / "x.json").read_text()) == found
    scenes = ["ideal", "modulus", "gains", "offsets", "force", "indenter", "modules"]
    assert list(found) == scenes
    assert {"position", "tilt", "gain", "offset", "modulus"} < set(found["offsets"])
    assert {"modulus", "force_scale", "force_offset"} < set(found["force"])
    assert {"indenter_offset x", "indenter_offset y"} < set(found["indenter"])
    assert {"position", "tilt", "spin"} < set(found["modules"])
    for rows in found.values():
        assert rows["fit"]["false_alarms"] == 0
        assert rows["fit"].get("rms_over_bound", 1.0) == pytest.approx(1.0, abs=0.12)
        for name, row in rows.items():
            assert name == "fit" or wide(row), (name, row)
    assert "95 % band" in capsys.readouterr().out


@pytest.mark.slow
def test_two_hundred_seeds(study):
    for name, rows in study.main(["--full"]).items():
        assert rows["fit"]["false_alarms"] <= 0.01
        assert rows["fit"].get("rms_over_bound", 1.0) < 1.05
        for quantity, row in rows.items():
            assert quantity == "fit" or wide(row), (name, quantity, row)
