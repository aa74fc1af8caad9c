"""Defects of skin files: each is found where it was made, and none in a correct file."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.skin import slots
from meshskin.skin.lint import lint
from meshskin.skin.skin import Skin

from ..real_data import DATA, needs_skin

POSITIONS = DATA / "icub_skin" / "positions"


@pytest.fixture(scope="module")
def arm():
    """Modules on a capsule."""
    return Skin.modules(Body.capsule(0.05, 0.2), count=20).skin


@pytest.fixture
def file(arm, tmp_path):
    """Their position file, with its four lines of header."""
    arm.save(tmp_path / "arm.txt")
    return tmp_path / "arm.txt"


def edit(path, change):
    """Let `change` edit the rows (n, 6) of a position file."""
    lines = path.read_text().splitlines()
    rows = np.array([line.split() for line in lines[4:]], dtype=float)
    rows = change(rows)
    text = [" ".join(f"{value:.9f}" for value in row) for row in rows]
    path.write_text("\n".join(lines[:4] + text) + "\n")


def kinds(defects):
    return [defect.kind for defect in defects]


def one(defects, kind):
    """The defect of a kind, which must be the only one."""
    assert kinds(defects) == [kind]
    assert defects[0].remedy
    return defects[0]


@pytest.mark.parametrize("kind", ["txt", "csv", "urdf", "ply", "glb"])
def test_correct_skins_have_no_defects_in_every_format(arm, tmp_path, kind):
    plain = Skin.cover(Body.sphere(), spacing=5e-3, count=80, region=Cap((0, 0, 1)))
    flat = Skin(se3.transform(np.eye(3), plain.positions * [1, 1, 0]), plain.ids)
    for name, skin in {"arm": arm, "plain": plain, "flat": flat}.items():
        skin.save(tmp_path / f"{name}.{kind}")
        assert lint(tmp_path / f"{name}.{kind}") == ()
        assert lint(skin) == ()


@pytest.mark.slow
def test_skins_of_a_whole_and_of_a_thin_body_have_no_defects():
    assert lint(Skin.cover(Body.torus(0.1, 0.03), spacing=12e-3)) == ()
    thin = Body.ellipsoid((0.1, 0.1, 0.005))
    assert lint(Skin.cover(thin, spacing=12e-3)) == ()


def change_one(row, value):
    def change(rows):
        rows[row] = value
        return rows

    return change


def scaled(row, factor):
    """A change that scales the normal of a row."""

    def change(rows):
        rows[row, 3:] *= factor
        return rows

    return change


def test_values_in_thermal_slots(file):
    edit(file, change_one(slice(18, 23, 4), [0.1, 0, 0, 0, 0, 1]))  # slots 6 and 10 of module 1
    found = one(lint(file), "thermal")
    assert found.taxels == (18, 22)
    assert found.modules == (1,)
    assert "2 thermal slots" in found.what


def test_a_constant_normal(file):
    edit(file, lambda rows: np.column_stack([rows[:, :3], np.any(rows, axis=1), 0 * rows[:, :2]]))
    found = one(lint(file), "constant normals")
    assert len(found.taxels) == 200
    assert "(1, 0, 0)" in found.what


def test_normals_that_are_missing_or_too_short(file):
    edit(file, change_one((5, slice(3, 6)), 0.0))
    assert one(lint(file), "no normal").taxels == (5,)
    edit(file, scaled(7, 0.5))
    assert kinds(lint(file)) == ["no normal", "not unit"]
    assert lint(file)[1].taxels == (7,)
    edit(file, lambda rows: rows * [1, 1, 1, 0, 0, 0])
    assert len(one(lint(file), "constant normals").taxels) == 200


def test_duplicate_positions(file):
    edit(file, lambda rows: rows[np.where(np.isin(np.arange(240), (4, 5)), 3, np.arange(240))])
    found = one(lint(file), "duplicate positions")
    assert found.taxels == (3, 4, 5)
    assert "200 taxels at 198 distinct positions" in found.what


def test_most_taxels_at_one_place(file):
    edit(file, lambda rows: np.where(np.arange(240)[:, None] % 12 < 6, rows, rows * 0 + rows[3]))
    assert "isolated" not in kinds(lint(file))


@pytest.mark.parametrize(
    ("entries", "what"),
    [
        (lambda e: [*e, *["-1"] * 12], "240 rows, 252 entries"),
        (lambda e: e[:228], "240 rows, 228 entries"),
    ],
)
def test_counts_that_do_not_agree(file, entries, what):
    lines = file.read_text().splitlines()
    listed = lines[2].removeprefix("taxel2Repr (").removesuffix(")").split()
    lines[2] = f"taxel2Repr ( {' '.join(entries(listed))} )"
    file.write_text("\n".join(lines))
    found = one(lint(file), "count")
    assert what in found.what
    assert found.taxels == (tuple(228 + s for s in slots.TAXELS) if "228" in what else ())


def test_rows_that_are_missing_or_too_many(file):
    edit(file, lambda rows: rows[:-2])
    assert kinds(lint(file)) == ["row count", "count"]
    assert lint(file)[1].taxels == (239,)
    assert "add the rows" in lint(file)[1].remedy


def test_listed_slots_without_position_and_the_other_way_round(file):
    edit(file, change_one(40, 0.0))
    assert one(lint(file), "missing").taxels == (40,)
    text = file.read_text().replace("( 3 3 ", "( 3 -1 ")
    file.write_text(text)
    assert kinds(lint(file)) == ["missing", "unlisted"]
    assert lint(file)[1].taxels == (1,)


def test_a_slot_that_names_another_module(file):
    file.write_text(file.read_text().replace("( 3 3 ", "( 3 15 "))
    assert one(lint(file), "taxel2Repr").taxels == (1,)


def test_numbers_that_are_not_finite(file):
    edit(file, change_one((9, 1), np.nan))
    assert one(lint(file), "not finite").taxels == (9,)
    with pytest.raises(SkinError):
        Skin.load(file)


def test_millimetres_taken_for_metres(file):
    edit(file, lambda rows: rows * [1000, 1000, 1000, 1, 1, 1])
    assert "unit" in kinds(lint(file))
    found = next(f for f in lint(file) if f.kind == "unit")
    assert "millimetres?" in found.what
    edit(file, lambda rows: rows / [1e6, 1e6, 1e6, 1, 1, 1])
    assert "kilometres?" in next(f for f in lint(file) if f.kind == "unit").what


def test_a_taxel_far_from_all_others(file):
    edit(file, change_one((60, 1), 0.3))
    found = {f.kind: f for f in lint(file)}
    assert set(found) == {"isolated", "off module"}
    assert found["isolated"].taxels == found["off module"].taxels == (60,)


def test_an_inward_normal(file):
    edit(file, scaled(3, -1.0))
    assert one(lint(file), "flipped").taxels == (3,)


def test_modules_seen_from_the_wrong_side(arm):
    local = slots.OFFSETS[slots.slot(arm.ids)] * [1, -1, 0]
    third = arm.ids // 12 == 3
    frames = arm.poses[arm.ids == 39]
    poses = arm.poses.copy()
    poses[third, :3, 3] = local[third] @ frames[0, :3, :3].T + frames[0, :3, 3]
    assert one(lint(Skin(poses, arm.ids)), "mirrored").modules == (3,)


def test_invalid_csv_lines_are_defects(arm, tmp_path):
    path = tmp_path / "skin.csv"
    arm.save(path)
    lines = path.read_text().splitlines()
    fields = lines[4].split(",")
    fields[0], fields[7:] = "-4", ["0.5", "0.1", "0.1", "0.1"]
    lines[4] = ",".join(fields)
    fields = lines[9].split(",")
    fields[0] = lines[8].split(",")[0]
    fields[4:7] = ["0", "0", "1"]
    lines[9] = ",".join(fields)
    path.write_text("\n".join(lines))
    found = {f.kind: f for f in lint(path)}
    assert {"duplicate ids", "negative ids", "quaternion", "frame"} <= set(found)
    assert found["negative ids"].taxels == found["quaternion"].taxels == (-4,)
    assert found["duplicate ids"].taxels == found["frame"].taxels


def test_a_single_taxel_has_no_defects():
    assert lint(Skin(np.eye(4)[None], np.array([0]))) == ()


KNOWN = {
    "torso": {"constant normals", "thermal", "duplicate positions"},
    "left_arm": {"constant normals", "count"},
    "left_arm_mesh": {"thermal", "not unit", "missing", "duplicate positions", "taxel2Repr"},
    "left_foot": {"constant normals", "count"},
    "left_leg_lower": {"constant normals", "count"},
    "left_leg_upper": {"constant normals", "count"},
    "left_hand_V2_1": {"constant normals", "missing", "unlisted"},
    "left_forearm_nomesh": {"constant normals", "thermal", "missing"},
    "left_forearm_mesh": {"thermal", "not unit"},
    "left_forearm_V2": {"duplicate positions", "mirrored"},
}


@needs_skin
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_the_defects_of_real_files(name):
    """Those of the data's own list, and others that are there as well."""
    assert set(kinds(lint(POSITIONS / f"{name}.txt"))) == KNOWN[name]


@needs_skin
def test_the_numbers_of_the_known_defects():
    def what(name, kind):
        return next(f.what for f in lint(POSITIONS / f"{name}.txt") if f.kind == kind)

    assert "240 taxels at 148 distinct" in what("left_forearm_V2", "duplicate positions")
    assert "1344 rows, 960 entries" in what("left_leg_upper", "count")
    assert "88 thermal slots" in what("torso", "thermal")
    assert "275 of 275 normals are (0, 0, 0)" in what("left_forearm_nomesh", "constant normals")


@needs_skin
def test_the_mirrored_modules_of_the_forearm_are_of_the_half_that_its_layout_mirrors():
    from meshskin.skin.files import icub_layout

    path = DATA / "icub_skin/layout/left_forearm_V2.ini"
    mirrored = {e.number for e in icub_layout.parse(path.read_text(), path.name) if e.mirror}
    found = next(f for f in lint(POSITIONS / "left_forearm_V2.txt") if f.kind == "mirrored")
    assert set(found.modules) <= mirrored
    assert len(found.modules) == 10


@needs_skin
def test_correct_real_files_have_no_defects():
    assert lint(DATA / "icub_skin/cad/left_foot_mesh.txt") == ()
    assert lint(DATA / "icub_skin/cad/l_sole_transforms.txt") == ()
    assert lint(DATA / "icub_skin/cad/taxeltrans.txt") == ()
    for part in ("l_sole", "r_sole", "l_forearm", "r_forearm", "r_lower_leg"):
        assert lint(DATA / "icub_body/iCubGazeboV2_5.urdf", part=part) == ()
    for path in (DATA / "icub_skin/layout").glob("*arm*.ini"):
        assert lint(path) == ()


@pytest.mark.deep
@pytest.mark.parametrize(
    "call",
    [
        lambda value: lint(value),
        lambda value: Skin.load(value),
        lambda value: Skin.cover(Body.sphere(0.1), spacing=20e-3).save(value),
    ],
)
def test_what_is_no_path_is_refused_with_its_value(call):
    for value in (3, Body.sphere(0.1)):
        with pytest.raises(SkinError, match=r"must be a path, got .*; give a file name"):
            call(value)


def test_a_part_of_a_skin_is_refused(arm):
    with pytest.raises(SkinError, match="part= chooses a skin of a file, got palm; leave it out"):
        lint(arm, part="palm")
