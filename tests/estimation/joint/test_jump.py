"""A jump of the contacts: a place in the recording before which there are contacts."""

from types import SimpleNamespace

import numpy as np

from meshskin.estimation.joint.jump import largest_jump


def fitted(count, begin):
    """Readings, one for each of `count` contacts, which those from `begin` on displace by 1 mm
    along x, under a standard deviation of 10 um, and the others by none."""
    moved = np.tile(np.eye(3), (count, 1)).reshape(count, 3, 3)[:, 0] * 1e5
    residual = np.where(np.arange(count) >= begin, 100.0, 0.0)
    return SimpleNamespace(
        data=SimpleNamespace(points=np.zeros((count, 3))),
        readings=SimpleNamespace(contact=np.arange(count)),
        moved=lambda directions: moved,
        shared=lambda columns: (columns.T @ residual, columns.T @ columns),
    )


def test_a_displacement_of_part_of_the_contacts_is_found_where_it_begins():
    found = largest_jump(fitted(160, 80))
    assert found.part == 0.5
    np.testing.assert_allclose(found.shown, [1e-3, 0.0, 0.0], atol=1e-12)


def test_a_displacement_of_all_contacts_is_no_jump():
    """Of fewer contacts than places the first place was the first contact."""
    assert largest_jump(fitted(1, 0)).score == 0.0
    assert largest_jump(fitted(8, 0)).part > 0
