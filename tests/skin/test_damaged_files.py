"""Damaged skin files of every format are refused in one line with file and remedy, or read."""

import random
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import MeshskinError, SkinError
from meshskin.geometry.body import Body
from meshskin.skin import files
from meshskin.skin.lint import check
from meshskin.skin.skin import Skin

KINDS = ("csv", "icub", "urdf", "urdf_tactile", "mjcf", "npz", "yaml", "ply", "glb")
LAYOUT = b"[SENSORS]\ntriangle_10pad 3 10.0 20.0 30.0 1 0\ntriangle 4 1 2 3 1 1\n"
TRANSFORMS = (
    b"t_TRIANGLE3 = iDynTree.Transform(iDynTree.Rotation(1,0,0,0,1,0,0,0,1), "
    b"iDynTree.Position(1,2,3))\n"
)
BARE = b"# six numbers\n0.1 0.2 0.3 0 0 1\n0.1 0.3 0.3 0 0 1\n"
VALUES = (
    b"nan", b"inf", b"-inf", b"1e400", b"", b"x", b"-3", b"0", b"9" * 30, b"1.5", b"\xff", b"\x00",
    b"[", b"{}", b"null", b"'", b"<", b"&", b"1,2", b"-",
)  # fmt: skip
NUMBER, WORD = rb"-?\d+(?:\.\d+)?(?:e-?\d+)?", rb"[A-Za-z_]+"


def damages(rng, data):
    """Content that is truncated, corrupt, cut, short of a line, or has a wrong number or word."""
    first, last = sorted(rng.randrange(len(data)) for _ in range(2))
    corrupt = bytearray(data)
    corrupt[first] = rng.randrange(256)
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    yield from (data[:first], bytes(corrupt), data[:first] + data[last:])
    yield b"\n".join(lines[:at] + lines[at + 1 :])
    yield b"\n".join(lines[: 1 + at])
    for pattern in (NUMBER, WORD):
        found = rng.choice(list(re.finditer(pattern, data)))
        yield data[: found.start()] + rng.choice(VALUES) + data[found.end() :]


@pytest.mark.parametrize("kind", [*KINDS, "layout", "transforms", "bare"])
def test_damaged_files_are_refused_in_one_line_or_read(tmp_path, kind):
    path, rng = tmp_path / "damaged.dat", random.Random(7)
    if kind in KINDS:
        skin = Skin.cover(Body.sphere(), spacing=5e-3, count=5)
        known = replace(skin, sigmas=np.array([np.nan, 1e-4, 1e-4, 1e-4, 1e-4]), frame="palm")
        known.save(path, kind)
        data = path.read_bytes()
    else:
        data = {"layout": LAYOUT, "transforms": TRANSFORMS, "bare": BARE}[kind]
    refusals = []
    for content in (content for _ in range(10) for content in damages(rng, data)):
        path.write_bytes(content)
        for read in (Skin.load, lambda path: check(files.read(path))):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    read(path)
                except MeshskinError as error:
                    refusals.append(str(error))
    assert len(refusals) > 10
    assert not [text for text in refusals if not re.match(r"damaged\.dat.*; \w", text)]


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"\n", b" ", b"ply\n", b"glTF", b"PK", b"<", b"<robot/>", b"transforms:\n"),
        *(b"[SENSORS]", b"name x\n[calibration]", b"iDynTree.Transform", bytes(50), b"\xff\xfe"),
    ],
)
def test_empty_files_and_heads_alone_are_refused(tmp_path, content):
    (tmp_path / "skin").write_bytes(content)
    with pytest.raises(SkinError, match=r"^skin .*; \w"):
        Skin.load(tmp_path / "skin")


POSES = np.tile(np.eye(4)[:3], (2, 1, 1))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"poses": np.array(["a", "b"])}, "wrong poses"),
        ({"poses": POSES * 1j}, "wrong poses"),
        ({"poses": -POSES}, "must be a rotation"),
        ({"poses": 0 * POSES}, "must be a rotation"),
        ({"poses": POSES * np.nan}, "must be finite"),
        ({"poses": POSES, "ids": [0.0, 1.0]}, "wrong ids"),
        ({"poses": POSES, "ids": [1]}, "wrong ids"),
        ({"poses": POSES, "sigma_m": ["a", "b"]}, "wrong sigma_m"),
        ({"poses": POSES, "disc_radius_m": [1.0, 2.0]}, "wrong disc_radius_m"),
        ({"poses": POSES, "disc_radius_m": np.nan}, "radius of the discs, got nan"),
        ({"points": POSES}, "has no poses"),
    ],
)
def test_archives_of_other_arrays_are_refused(tmp_path, arrays, words):
    np.savez(tmp_path / "skin.npz", **arrays)
    with pytest.raises(SkinError, match=f"skin.npz.*{words}.*;"):
        Skin.load(tmp_path / "skin.npz")


def test_a_mark_of_byte_order_is_skipped(tmp_path):
    """Spreadsheets write one."""
    path = tmp_path / "skin.csv"
    Skin.cover(Body.sphere(), spacing=5e-3, count=5).save(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(Skin.load(path)) == 5
