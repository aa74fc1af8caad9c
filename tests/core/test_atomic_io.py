"""Files that are written whole or not at all."""

import errno
import json

import numpy as np
import pytest

from meshskin.core.atomic_io import atomic, check_folder, write_json
from meshskin.core.errors import OutputError


@pytest.mark.parametrize("error", [FileNotFoundError, None])
def test_an_error_of_the_body_keeps_its_own_words(tmp_path, error):
    other = tmp_path / "other.csv"
    with (
        pytest.raises(error or OSError, match="other.csv" if error else "cannot identify"),
        atomic(tmp_path / "file.txt"),
    ):
        if error is None:
            raise OSError("cannot identify the image")
        other.read_text()
    assert not list(tmp_path.iterdir())


def test_an_error_of_writing_names_the_file(tmp_path):
    full = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OutputError, match=r"cannot write .*file.txt, got No space"):  # noqa: SIM117
        with atomic(tmp_path / "file.txt"):
            raise full
    with pytest.raises(OutputError, match=r"cannot write .*file.txt, got Is a directory"):  # noqa: SIM117
        with atomic(tmp_path / "file.txt") as temporary:
            temporary.unlink()
            temporary.mkdir()
            try:
                temporary.write_text("")
            finally:
                temporary.rmdir()
    assert not list(tmp_path.iterdir())


def test_numbers_of_numpy_are_written(tmp_path):
    value = {
        np.int64(3): np.int32(2), "b": [np.float32(0.5), np.float64("nan")], "c": np.bool_(True),
        "d": np.array([[1.0, np.inf]]), "e": (np.arange(2), "text", None),
    }  # fmt: skip
    write_json(tmp_path / "x.json", value)
    assert json.loads((tmp_path / "x.json").read_text()) == {
        "3": 2, "b": [0.5, None], "c": True, "d": [[1.0, None]], "e": [[0, 1], "text", None],
    }  # fmt: skip


def test_a_folder_that_cannot_be_written_is_named_without_the_probe(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot write .*file/metrics.json, got"):
        check_folder(tmp_path / "file")
