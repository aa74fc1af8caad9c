"""The folder of a study: whole files or none, one writer."""

import math
import os
import signal
import subprocess
import sys

import pytest

from meshskin.core.errors import OutputError, StudyError
from meshskin.core.provenance import digest
from meshskin.study.sweep.case import DIED, MEMORY, RAISED, TIMEOUT, Limits, Outcome
from meshskin.study.sweep.store import Store, _column

KEY = "3fa0b1c2d3e4f506"


def test_a_result_is_read_as_it_was_written(out):
    store, limits = Store(out), Limits(5.0, None)
    outcome = Outcome(KEY, {"y": 0.1 + 0.2, "n": 3, "bad": math.inf}, seconds=1.5, limits=limits)
    store.write(outcome)
    assert store.read(KEY) == outcome
    assert store.keys() == {KEY}
    assert store.read("0" * 16) is None


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([None, None], [None, None]),
        ([1, None, 2.5], [1.0, None, 2.5]),
        ([True, None, False], [True, None, False]),
        ([1, True], ["1", "True"]),
        ([0.5, True, None], ["0.5", "True", None]),
        (["a", 1], ["a", "1"]),
    ],
)
def test_values_of_several_types_are_text_in_a_table(values, expected):
    for order in (1, -1):
        found = _column(values[::order]).to_pylist()[::order]
        assert found == expected
        assert [type(value) for value in found] == [type(value) for value in expected]


def test_an_incomplete_file_is_ignored(out):
    store = Store(out)
    store.write(Outcome(KEY, {"y": 1.0}))
    file = store.file(KEY)
    whole = file.read_bytes()
    for size in range(len(whole) - 1):  # the last byte is the end of the line
        file.write_bytes(whole[:size])
        assert store.read(KEY) is None
    for flipped in (3, 40, len(whole) - 5):
        file.write_bytes(whole[:flipped] + bytes([whole[flipped] ^ 255]) + whole[flipped + 1 :])
        assert store.read(KEY) is None
    file.write_bytes(whole)
    assert store.read(KEY) is not None


def test_a_result_of_another_schema_is_ignored_with_a_note(out):
    store = Store(out)
    store.write(Outcome(KEY, {"y": 1.0}))
    for body in ('{"key": "3fa0b1c2d3e4f506"}', '{"limits": {}, "unknown": 1}', "[1]", "3"):
        store.file(KEY).write_text(f"{digest(body)}\n{body}\n")
        with pytest.warns(UserWarning, match="another version of meshskin"):
            assert store.read(KEY) is None


def test_a_result_under_another_name_is_ignored(out):
    store = Store(out)
    store.write(Outcome(KEY, {"y": 1.0}))
    other = KEY[:-1] + "7"
    store.file(KEY).rename(store.file(other))
    assert store.read(other) is None


def test_the_temporary_file_of_a_killed_writer_is_removed(out):
    store = Store(out)
    store.write(Outcome(KEY))
    left = store.file(KEY).parent / ".x.json.abc.part"
    left.touch()
    assert store.keys() == {KEY}
    assert not left.exists()


def test_one_process_holds_the_lock_and_its_death_releases_it(out):
    code = (
        "import sys, time; from meshskin.study.sweep.store import Store\n"
        "with Store(sys.argv[1]).lock(): print('held', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(out)], stdout=subprocess.PIPE)
    try:
        assert other.stdout.readline() == b"held\n"
        line = f"another run is writing .* process {other.pid} on"
        with pytest.raises(StudyError, match=line), Store(out).lock():
            pass
    finally:
        other.send_signal(signal.SIGKILL)
        other.wait()
        other.stdout.close()
    with Store(out).lock():
        assert out.is_dir()


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_one_error_line(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="cannot write"), Store(tmp_path / "out").lock():
        pass


def test_a_file_in_place_of_the_folder_is_one_error_line(out):
    out.touch()
    with pytest.raises(OutputError, match="cannot write"), Store(out).lock():
        pass


@pytest.mark.parametrize(
    ("reason", "then", "now", "is_final"),
    [
        (None, Limits(), Limits(1.0, 1e6), True),
        (RAISED, Limits(), Limits(), True),
        (DIED, Limits(), Limits(), False),
        (TIMEOUT, Limits(5.0), Limits(5.0), True),
        (TIMEOUT, Limits(5.0), Limits(4.0), True),
        (TIMEOUT, Limits(5.0), Limits(6.0), False),
        (TIMEOUT, Limits(5.0), Limits(None), False),
        (MEMORY, Limits(None, 1e9), Limits(None, 1e9), True),
        (MEMORY, Limits(None, 1e9), Limits(None, 2e9), False),
        (MEMORY, Limits(), Limits(), True),
    ],
)
def test_outcomes_that_are_not_final_are_run_again(reason, then, now, is_final):
    assert Outcome(KEY, reason=reason, limits=then).is_final(now) is is_final
