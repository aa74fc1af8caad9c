"""Cache by content: a function runs once for equal contents of different objects."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import content_cache
from meshskin.robot.inverse_kinematics import newton
from meshskin.simulation.closed_loop_model import ClosedLoopModel
from meshskin.simulation.integrators import step


def test_equal_contents_are_built_once():
    built = []

    @content_cache.cached_by_content
    def total(numbers):
        """A sum."""
        built.append(len(numbers))
        return float(np.sum(numbers))

    assert total.__doc__ == "A sum."
    assert [total(np.arange(3.0)), total(np.arange(3.0))] == [3.0, 3.0]
    assert built == [3]
    assert total(np.arange(3)) == 3.0, "the type is part of the content"
    for k in range(4, 4 + content_cache.CACHE_SIZE):
        total(np.arange(float(k)))
    assert len(built) == 2 + content_cache.CACHE_SIZE
    total(np.arange(3.0))
    assert len(built) == 3 + content_cache.CACHE_SIZE, "the least recently used is dropped"


@pytest.fixture
def loop():
    return ClosedLoopModel.of(ms.Scene.load("sphere"))


def test_scenes_of_the_same_content_share_their_functions(loop):
    other = ClosedLoopModel.of(ms.Scene.load("sphere"))
    assert other.arm is not loop.arm
    assert step(other) is step(loop)
    assert newton(other.arm) is newton(loop.arm)


def test_every_field_of_the_loop_is_part_of_the_content(loop):
    changed = {
        "arm": loop.arm.with_payload(0.1, np.zeros(3), 1e-4 * np.eye(3)),
        "mount": loop.mount @ np.diag([1.0, -1.0, -1.0, 1.0]),
        "indenter_position": loop.indenter_position + 0.01,
        "indenter_radius": 0.012,
        "effective_modulus": 3e5,
        "law": replace(loop.law, torque="paper"),
        "dt": 2e-3,
        "integrator": "rk4",
        "mode": "quasi_static",
        "contact": replace(loop.contact, name="elliptic"),
        "delay": 2,
        "indenter_direction": np.array([1.0, 0.0, 0.0]),
    }
    assert set(changed) == {f.name for f in fields(loop)}
    made = content_cache.cached_by_content(lambda loop: object())
    assert made(loop) is made(replace(loop))
    for name, value in changed.items():
        assert made(replace(loop, **{name: value})) is not made(loop), name


def test_a_result_is_kept_on_its_argument():
    @dataclass(frozen=True)
    class Numbers:
        """Numbers."""

        first: float

    asked = []

    @content_cache.cached_on_argument
    def double(numbers):
        asked.append(numbers.first)
        return 2 * numbers.first

    one = Numbers(1.0)
    assert [double(one), double(one), double(replace(one, first=3.0))] == [2.0, 2.0, 6.0]
    assert asked == [1.0, 3.0]
    assert one == Numbers(1.0)
