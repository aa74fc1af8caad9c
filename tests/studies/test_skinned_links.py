"""The study of links in a skin, on a folder: a mesh that works, and one that cannot be a body."""

import json

import pytest
import trimesh


@pytest.fixture
def study(script):
    return script("skinned_links")


@pytest.mark.deep
def test_a_folder_of_meshes_is_measured(study, monkeypatch, tmp_path, capsys):
    trimesh.creation.icosphere(subdivisions=4, radius=0.04).export(tmp_path / "ball.obj")
    trimesh.creation.icosphere(subdivisions=2, radius=0.001).export(tmp_path / "tiny.stl")
    out = tmp_path / "skinned.jsonl"
    options = ["--taxels", "20", "--kind", "bare", "--out", str(out)]
    monkeypatch.setattr(study, "DENSE", 30_000)
    monkeypatch.setattr("sys.argv", ["skinned_links", str(tmp_path), *options])
    assert study.main() == 0
    ball, tiny = (json.loads(text) for text in out.read_text().splitlines())
    assert ball["fits"] == 1.0
    assert 0.5 < ball["fit_calibrated"] <= 1.0
    assert ball["wrong"] == []
    assert "extent" in tiny["refused"]
    assert "bare, 2 meshes" in capsys.readouterr().out
