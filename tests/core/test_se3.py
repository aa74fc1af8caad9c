"""Rigid transforms against SciPy's matrix exponential, and inverses of each other."""

import numpy as np
import pytest
from scipy.linalg import expm

from meshskin.core import se3


def test_exponential_is_the_matrix_exponential():
    w = np.random.default_rng(1).normal(size=(20, 3)) * np.logspace(-9, 0.4, 20)[:, None]
    expected = np.stack([expm(se3.hat(v)) for v in w])
    np.testing.assert_allclose(se3.exp_so3(w), expected, atol=1e-14)


def test_left_jacobian_is_the_derivative_of_the_exponential():
    rng = np.random.default_rng(3)
    w = rng.normal(size=(20, 3)) * np.logspace(-6, 0.3, 20)[:, None]
    jacobian, step = se3.left_jacobian(w), 1e-6
    for k, axis in enumerate(np.eye(3)):
        ends = (se3.exp_so3(w + sign * step * axis) for sign in (1, -1))
        turned = next(ends) @ np.swapaxes(next(ends), 1, 2)
        np.testing.assert_allclose(se3.log_so3(turned) / (2 * step), jacobian[:, :, k], atol=1e-7)


def test_logarithm_inverts_the_exponential_up_to_pi():
    axis = np.random.default_rng(2).normal(size=(8, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    for angle in (0.0, 1e-12, 1e-4, 1.0, 3.0, np.pi - 1e-9):
        w = angle * axis
        np.testing.assert_allclose(se3.log_so3(se3.exp_so3(w)), w, atol=2e-8)
    turned = se3.log_so3(se3.exp_so3(np.pi * axis))
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.pi, atol=1e-7)


def test_inverse_and_align_recover_a_transform():
    rng = np.random.default_rng(3)
    pose = se3.transform(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    np.testing.assert_allclose(se3.inverse(pose) @ pose, np.eye(4), atol=1e-14)
    a = rng.normal(size=(30, 3))
    b = a @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(se3.align(a, b), pose, atol=1e-12)


def test_align_never_mirrors():
    a = np.random.default_rng(4).normal(size=(10, 3))
    found = se3.align(a, a * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) > 0


def test_a_rigid_transform_neither_scales_nor_mirrors_nor_shears():
    pose = se3.transform(se3.exp_so3([0.3, -2.0, 1.0]), [1.0, 2.0, -3.0])
    assert se3.is_rigid(pose)
    wrong = [1.001 * pose, pose[:3], pose * np.nan, np.diag([-1.0, 1.0, 1.0, 1.0])]
    sheared = pose.copy()
    sheared[0] += 0.01 * sheared[1]
    assert not any(map(se3.is_rigid, [*wrong, sheared]))


def unit(count, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("tangents", [None, se3.perpendicular])
def test_orthonormal_basis_is_a_rotation_with_the_normal_last(tangents):
    normals = np.concatenate([unit(50), np.eye(3), -np.eye(3)])
    given = None if tangents is None else tangents(normals)
    basis = se3.orthonormal_basis(normals, given)
    assert np.allclose(np.swapaxes(basis, 1, 2) @ basis, np.eye(3), atol=1e-14)
    assert np.allclose(np.linalg.det(basis), 1.0)
    assert np.array_equal(basis[..., 2], normals)
    assert np.array_equal(se3.orthonormal_basis(normals[3]), se3.orthonormal_basis(normals)[3])


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.05, 1.0])
def test_shortest_rotation_near_opposite_vectors(off):
    source = np.concatenate([unit(50), np.eye(3), -np.eye(3)])
    target = -source + off * unit(len(source), seed=2)
    target /= np.linalg.norm(target, axis=1, keepdims=True)
    rotation = se3.shortest_rotation(source, target)
    assert np.allclose(np.swapaxes(rotation, 1, 2) @ rotation, np.eye(3), atol=1e-12)
    assert np.allclose(np.einsum("nij,nj->ni", rotation, source), target, atol=1e-11)
    cosine = np.einsum("ni,ni->n", source, target)
    assert np.allclose(np.trace(rotation, axis1=1, axis2=2), 1 + 2 * cosine, atol=1e-9)


def test_shortest_rotation_of_one_vector_to_many():
    target = unit(7)
    rotation = se3.shortest_rotation([0.0, 0.0, 1.0], target)
    assert np.allclose(rotation[:, :, 2], target)


def test_angles_of_a_urdf_are_read_back():
    rng = np.random.default_rng(0)
    for rpy in [
        *rng.uniform(-np.pi, np.pi, (50, 3)),
        [0.3, np.pi / 2, 0.4],
        [1.0, -np.pi / 2, 2.0],
    ]:
        turn = se3.from_rpy(rpy)
        np.testing.assert_allclose(se3.from_rpy(se3.to_rpy(turn)), turn, atol=1e-15)
