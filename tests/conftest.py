"""Scenes and recordings that several tests look at."""

import pytest

import meshskin as ms


@pytest.fixture(scope="session")
def sphere():
    """The paper's scene."""
    return ms.Scene.load("sphere")


@pytest.fixture(scope="session")
def recording(sphere):
    """Its recording, without noise."""
    return ms.simulate(sphere, seed=1)


@pytest.fixture(scope="session")
def noisy():
    """The paper's scene with 1 % noise."""
    return ms.Scene.load("sphere_noisy")


@pytest.fixture(scope="session")
def noisy_recording(noisy):
    """Its recording."""
    return ms.simulate(noisy, seed=1)
