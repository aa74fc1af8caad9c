"""Batches: every episode is what the simulator gives alone; own parameters; failures named."""

from dataclasses import replace

import numpy as np
import pytest
from batch_simulator import BatchSimulator
from point_readings import PointReadings

from meshskin.core import codegen as module
from meshskin.core.errors import SimulationError
from meshskin.simulation.closed_loop_model import Parameters
from meshskin.simulation.track import Track


@pytest.fixture(scope="module")
def track(prepared, sphere):
    return Track.of(prepared()[1], sphere.body.surface)


def test_an_episode_of_the_batch_is_the_machine_alone(prepared, sphere, track, along):
    simulator, path = prepared()
    rows = np.array([300, 2000])
    batch = BatchSimulator(sphere.body, simulator.loop, track, rows, along[rows], compile_="never")
    found = np.array([batch.advance().copy() for _ in range(200)])
    for k, row in enumerate(rows):
        simulator.reset()
        simulator.state[:6] = along[row]
        hit = sphere.body.closest(path.points[row : row + 1])
        simulator.state[-2:], simulator.face = hit.uv[0], int(hit.face[0])
        alone = simulator.advance(track[row : row + 200], 2).outputs
        np.testing.assert_allclose(found[: len(alone), k], alone, rtol=1e-6, atol=1e-9)
        assert len(alone) == 200


@pytest.mark.skipif(module.find_compiler() is None, reason="no C compiler here")
def test_a_compiled_batch_is_the_interpreted_one(prepared, sphere, track):
    simulator, _ = prepared("quasi_static")
    rows = np.linspace(0, len(track) - 300, 40).astype(int)
    wanted = np.linspace(1.0, 4.0, 40)
    own = simulator.loop.parameters
    parameters = np.array([replace(own, force_reference=f).values for f in wanted])
    one, other = (
        BatchSimulator(
            sphere.body, simulator.loop, track, rows,
            parameters=parameters, compile_=compile_, taxels=sphere.skin.positions,
        )
        for compile_ in ("never", "always")
    )  # fmt: skip
    for _ in range(250):
        np.testing.assert_allclose(one.advance(), other.advance(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.readings, other.readings, atol=1e-3 * one.readings.max())
    other.state[3] = np.nan
    with pytest.raises(SimulationError, match="episode 3 diverged"):
        other.advance()


def test_without_an_arm_every_episode_holds_the_force(prepared, sphere, track):
    simulator, _ = prepared("quasi_static")
    rows = np.linspace(0, len(track) - 300, 40).astype(int)
    batch = BatchSimulator(
        sphere.body, simulator.loop, track, rows, compile_="never", taxels=sphere.skin.positions
    )
    for _ in range(250):
        found = batch.advance()
    np.testing.assert_allclose(found[:, 6], 3.0, rtol=1e-4)
    exact = PointReadings(simulator.loop, sphere.skin.positions)(found)
    np.testing.assert_allclose(batch.readings, exact, atol=1e-3 * exact.max())
    assert (batch.readings[:30].max(axis=1) > 0).all()  # the last lanes run outside the skin


def test_episodes_have_their_own_parameters_and_rest_at_the_end(prepared, sphere, track):
    simulator, path = prepared("quasi_static")
    own = simulator.loop.parameters
    wanted = np.array([1.0, 2.0, 4.0])
    parameters = np.array([replace(own, force_reference=f).values for f in wanted])
    rows = np.full(3, len(track) - 20)
    batch = BatchSimulator(
        sphere.body, simulator.loop, track, rows, parameters=parameters, compile_="never"
    )
    for _ in range(400):
        found = batch.advance()
    np.testing.assert_allclose(found[:, 6], wanted, rtol=1e-4)
    np.testing.assert_allclose(found[:, :3], np.tile(path.points[-1], (3, 1)), atol=2e-4)
    assert Parameters.split(parameters[1]).force_reference == 2.0


def test_a_diverging_episode_is_named(prepared, sphere, track):
    simulator, _ = prepared("quasi_static")
    own = simulator.loop.parameters
    parameters = np.array([own.values, replace(own, effective_modulus=np.nan).values])
    batch = BatchSimulator(
        sphere.body,
        simulator.loop,
        track,
        np.array([0, 0]),
        parameters=parameters,
        compile_="never",
    )
    with pytest.raises(SimulationError, match=r"episode 1 diverged at t = 0.0000 s"):
        batch.advance()
