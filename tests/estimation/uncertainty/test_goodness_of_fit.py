"""The test of fit: leverages against the dense hat matrix, and a statistic with the mean of one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import meshskin as ms
from meshskin.estimation import chart
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import module_parametrization
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.pressure import CENSORED, censored
from meshskin.estimation.joint.readings import select
from meshskin.estimation.joint.variable_projection import ReducedProblem
from meshskin.estimation.uncertainty.goodness_of_fit import (
    goodness_of_fit,
    remedy_of_learned,
    undeclared,
)
from meshskin.scene.contact_motion import ContactMotion

STEP = 1e-6


@pytest.fixture(scope="module")
def sparse(world):
    """Few contacts: some seven readings a taxel."""
    return type(world)(extent=17e-3, lane=5e-3, step=2.5e-3)


def prepared(world, rigid):
    """A settled problem at few readings: taxels by themselves, or six of them on two modules."""
    unknown = ("modulus", "force_offset", "gain", "offset")
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05, unknown=unknown))
    live = np.arange(len(world.ids))
    if rigid:
        live = np.argsort(np.linalg.norm(world.truth - world.truth.mean(axis=0), axis=1))[:6]
        frame = chart.frames(world.body.closest(world.truth[live[[0, 3]]]).normal)
        arms = world.truth[live].reshape(2, 3, 3) - world.truth[live[[0, 3]]][:, None]
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = frame, world.truth[live[[0, 3]]]
        offsets = np.einsum("gji,gsj->gsi", frame, arms).reshape(-1, 3)
        group = np.repeat([0, 1], 3)
        places = module_parametrization.ModuleParametrization.about(
            world.body, poses, group, offsets, 2e-3
        )
    else:
        places = SurfaceParametrization(chart.charts_at(world.body, world.truth), 2e-3)
    weight = np.random.default_rng(0).uniform(0.2, 1.0, len(data.pressure))
    readings = select(
        data, live, places.points(), places.rotations()[:, :, 2], 0.0, weight, np.ones(len(live))
    )
    likelihood = Likelihood(data, readings)
    problem = ReducedProblem(likelihood, places, LinearizedContacts(data, np.zeros(2)))
    state = problem.start(np.zeros(2))
    problem.solve_inner(state)
    return problem, state


def differences(function, x, scale):
    """d function / d x (k, p) by central differences, in units of `scale` (p,)."""
    steps = STEP * np.diag(scale)
    return np.stack([(function(x + d) - function(x - d)) / (2 * STEP) for d in steps], axis=1)


@pytest.mark.parametrize("rigid", [False, True])
def test_leverages_are_the_diagonal_of_the_dense_hat_matrix(sparse, rigid):
    problem, state = prepared(sparse, rigid)
    places, likelihood, read = (
        problem.parametrization,
        problem.likelihood,
        problem.likelihood.readings,
    )
    group, rows, size = places.group, np.arange(len(places.group)), places.size

    def mu(x):
        z, s = x[:-2].reshape(state.z.shape), x[-2:]
        points = places.at(z[group, :size], group, rows)[0]
        extras = problem.nuisance(z, np.arange(places.count))
        return likelihood.means(points, extras, problem.contacts.at(s))

    x = np.concatenate([state.z.ravel(), state.s])
    local = np.where(np.arange(problem.width) < size, 1e-3, 1.0)
    scale = np.concatenate([np.tile(local, places.count), [1.0, 1.0]])
    slope, silent = differences(mu, x, scale), read.kind == CENSORED
    excess = mu(x) - read.level / likelihood.data.sigma
    weight = read.weight * np.where(silent, censored(excess)[2], 1.0)
    known = np.tile(np.square(likelihood.nuisance_sigma) ** -1.0, (problem.width - size) // 2)
    known = np.concatenate([np.full(size, 1e2), known])
    priors = np.concatenate([np.tile(known, places.count), likelihood.data.parameters.sigma**-2.0])
    information = slope.T @ (weight[:, None] * slope) + np.diag(priors * scale**2)
    if rigid:  # and each taxel's height over the surface
        height = differences(lambda x: heights(places, x[:-2].reshape(state.z.shape)), x, scale)
        information += height.T @ height / module_parametrization.SURFACE_SIGMA**2
    covariance = np.linalg.inv(information) * np.outer(scale, scale)
    blocks, shared = problem.covariances(state, problem.reduce(state))
    width = problem.width
    for k, block in enumerate(blocks):
        dense = covariance[k * width : (k + 1) * width, k * width : (k + 1) * width]
        size = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
        assert np.abs((block - dense) / size).max() < 5e-3
    assert np.allclose(shared, covariance[-2:, -2:], rtol=1e-4)
    hat = weight * np.einsum("ki,ik->k", slope, np.linalg.solve(information, slope.T))
    own = problem.leverages(state, problem.reduce(state))
    assert silent.any()
    assert 0.05 < own[~silent].mean() < 1.0
    assert np.allclose(own, hat, atol=2e-5)
    first = np.flatnonzero(np.diff(read.taxel) == 0)
    apart = slope[first + 1] - slope[first]
    dense = 2 - np.einsum("ki,ik->k", apart, np.linalg.solve(information, apart.T))
    pairs = problem.difference_variances(state, problem.reduce(state), first, first + 1)
    assert pairs.min() < 1.8
    assert np.allclose(pairs, np.maximum(dense, 0.0), atol=1e-3)


def heights(places, z):
    """Heights (n,), m, over the planes that touch the surface below each taxel's anchor."""
    x = places.at(z[places.group, :6], places.group, np.arange(len(places.group)))[0]
    return places.height + np.einsum("ni,ni->n", places.normals, x - places.points())


@pytest.mark.deep
@pytest.mark.parametrize("seeds", [8, pytest.param(300, marks=pytest.mark.slow)])
def test_the_statistic_has_the_mean_of_one_at_few_readings_a_taxel(sparse, seeds):
    """Seven readings and two unknowns: without leverages the mean would be 5 / 7."""
    belief = sparse.belief(0.01, 0.05)
    fits = [calibrate(sparse.record(0.01, 0.05, seed), belief).fit for seed in range(seeds)]
    square, freedom = np.sum([(fit.chi2, fit.freedom) for fit in fits], axis=0)
    assert abs(square / freedom - 1) < 3 * np.sqrt(2 / freedom)
    assert sum("overstated" in fit.words for fit in fits) <= 2


def test_the_model_is_rejected_once_in_a_thousand():
    for level, good in ((1e-2, True), (2e-3, True), (5e-4, False), (1e-8, False)):
        assert goodness_of_fit(chi2.isf(level, 500), 500, noise_known=True).good is good
    assert "overstated" in goodness_of_fit(chi2.ppf(5e-4, 500), 500, noise_known=True).words
    assert goodness_of_fit(1e3, 500, noise_known=False).good is None
    assert goodness_of_fit(500.0, 500, noise_known=False, pairs=400).pairs == 400
    assert goodness_of_fit(0.0, 0.0, noise_known=True).words == "not tested: too few readings"


def test_remedies_are_those_that_the_belief_can_take():
    """Raw readings have no contact model; what is declared need not be declared again."""
    known = ms.Scene.load("sphere").belief(contact="learned")
    raw = replace(known, readings="raw", noise_sigma=None, threshold=0.0)
    assert undeclared(known) == "declare body_offset or indenter_offset unknown"
    assert undeclared(replace(known, unknown=("body_offset",))) == "declare indenter_offset unknown"
    assert "elliptic" in remedy_of_learned(known)
    assert remedy_of_learned(raw) == undeclared(raw) == undeclared(known)

    def moved(*labels):
        sigma = np.ones(len(labels))
        return replace(
            raw, contact_motion=ContactMotion(labels, sigma, np.zeros((2, 3, len(sigma))))
        )

    assert undeclared(moved("body_offset x", "body_offset y")) == "declare indenter_offset unknown"
    usual = "joint_offset a", "indenter_position x", "clock_offset"
    assert remedy_of_learned(moved(*usual)) == (
        "declare mount or indenter_radius or mesh_scale unknown"
    )
    every = moved(*usual, "mount x", "indenter_radius", "mesh_scale")
    assert undeclared(every) == ""
    assert remedy_of_learned(every) == "see the other reasons"
