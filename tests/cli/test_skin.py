"""`meshskin lint` and `meshskin diff` as a user meets them."""

import numpy as np
import pytest

from meshskin import cli
from meshskin.geometry.body import Body
from meshskin.skin.skin import Skin


@pytest.fixture(scope="module")
def arm():
    return Skin.modules(Body.capsule(0.05, 0.2), count=6).skin


def fails(capsys, *arguments):
    """Run a command that must fail with exit code 2 and one line; return the line."""
    assert cli.main([*map(str, arguments)]) == 2
    out = capsys.readouterr()
    assert out.out == ""
    assert len(out.err.strip().splitlines()) == 1
    return out.err


def test_lint_of_a_clean_file(arm, tmp_path, capsys):
    arm.save(tmp_path / "arm.txt")
    assert cli.main(["lint", str(tmp_path / "arm.txt")]) == 0
    assert capsys.readouterr().out == "arm.txt: icub, 60 taxels, no defect found\n"


def test_lint_names_taxels_modules_and_a_remedy(arm, tmp_path, capsys):
    poses = arm.poses.copy()
    poses[10:18, :3, 3] = poses[9, :3, 3]
    Skin(poses, arm.ids).save(tmp_path / "arm.csv")
    assert cli.main(["lint", str(tmp_path / "arm.csv")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "arm.csv: csv, 60 taxels, 1 defect"
    assert lines[2].startswith("duplicate positions: 60 taxels at 52 distinct positions")
    assert lines[3] == "  taxels   11-17, 19-20"
    assert lines[4] == "  modules  0-1"
    assert lines[5].startswith("  remedy   ")


def test_long_lists_are_cut_unless_asked_for(arm, tmp_path, capsys):
    poses = arm.poses.copy()
    poses[:, :3, :3] = np.eye(3)
    Skin(poses, arm.ids).save(tmp_path / "arm.txt")
    assert cli.main(["lint", str(tmp_path / "arm.txt")]) == 1
    assert " more (--all)" in capsys.readouterr().out
    assert cli.main(["lint", str(tmp_path / "arm.txt"), "--all"]) == 1
    assert "67-69, 71\n" in capsys.readouterr().out


def test_lint_of_what_cannot_be_read(tmp_path, capsys):
    assert "nowhere" in fails(capsys, "lint", tmp_path / "nowhere.txt")
    (tmp_path / "prose.txt").write_text("a skin, once upon a time")
    assert "not a skin file" in fails(capsys, "lint", tmp_path / "prose.txt")


def test_a_part_is_chosen(arm, tmp_path, capsys):
    arm.save(tmp_path / "left.urdf")
    assert cli.main(["lint", str(tmp_path / "left.urdf"), "--part", "left"]) == 0
    capsys.readouterr()
    assert "limit: left" in fails(capsys, "lint", tmp_path / "left.urdf", "--part", "right")
    arm.save(tmp_path / "left.csv")
    part = ("--part", "left")
    assert "leave part=" in fails(capsys, "lint", tmp_path / "left.csv", *part)
    assert "leave it out" in fails(capsys, "diff", *2 * [tmp_path / "left.csv"], *part)
    files = [str(tmp_path / name) for name in ("left.csv", "left.urdf")]
    assert cli.main(["diff", *files, *part]) == 0  # of the one that has parts


def test_diff_of_the_same_skin(arm, tmp_path, capsys):
    arm.save(tmp_path / "a.csv")
    arm.save(tmp_path / "b.urdf")
    assert cli.main(["diff", str(tmp_path / "a.csv"), str(tmp_path / "b.urdf")]) == 0
    assert "equal within 1 um" in capsys.readouterr().out


def test_diff_names_exchanged_modules(arm, tmp_path, capsys):
    change = {1: 4, 4: 1}
    modules = np.array([change.get(m, m) for m in (arm.ids // 12).tolist()])
    arm.save(tmp_path / "a.txt")
    Skin(arm.poses, 12 * modules + arm.ids % 12).save(tmp_path / "b.txt")
    assert cli.main(["diff", str(tmp_path / "a.txt"), str(tmp_path / "b.txt")]) == 1
    out = capsys.readouterr().out
    assert "60 in both, 0 only in A, 0 only in B" in out
    assert "modules 1 and 4 exchanged\nthis explains the difference" in out
    table = {line[:28].strip(): line[28:].split() for line in out.splitlines()}
    assert table["aligned and modules permuted"] == ["60", "0.0000", "0.0000", "0.0000"]
    assert float(table["aligned"][3]) > 10.0


def test_diff_lists_the_worst_taxels(arm, tmp_path, capsys):
    poses = arm.poses.copy()
    poses[7, 0, 3] += 1e-3
    arm.save(tmp_path / "a.csv")
    Skin(poses, arm.ids).save(tmp_path / "b.csv")
    assert cli.main(["diff", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--worst", "1"]) == 1
    out = capsys.readouterr().out
    assert "no exchange of ids explains" in out
    assert "worst taxels (mm): 8: 1.000" in out


def test_diff_of_what_cannot_be_read(arm, tmp_path, capsys):
    arm.save(tmp_path / "a.csv")
    assert "--worst" in fails(capsys, "diff", *2 * [tmp_path / "a.csv"], "--worst", "-3")
    assert "nowhere" in fails(capsys, "diff", tmp_path / "a.csv", tmp_path / "nowhere")


def test_diff_shortens_a_long_list(tmp_path, capsys):
    """Forty pairs of taxels exchanged, on a skin without modules."""
    skin = Skin.cover(Body.sphere(), count=100, spacing=6e-3)
    ids = np.concatenate([np.arange(80) ^ 1, np.arange(80, 100)])
    skin.save(tmp_path / "a.csv")
    Skin(skin.poses, ids).save(tmp_path / "b.csv")
    line = ["diff", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    assert cli.main(line) == 1
    out = capsys.readouterr().out
    assert out.count("exchanged\n") == 20
    assert "and 20 more lines (--all)\nthis explains the difference" in out
    assert cli.main([*line, "--all"]) == 1
    assert capsys.readouterr().out.count("exchanged\n") == 40
