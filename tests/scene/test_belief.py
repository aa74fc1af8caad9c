"""Beliefs refuse what cannot be meant, at once and in words."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, UnknownNameError


def belief(sphere, **changes):
    known = {"taxel_ids": [0, 1, 2]} | changes
    return ms.Belief(sphere.body, sphere.indenter, sphere.material, **known)


def test_the_contact_model_is_chosen_by_default(sphere):
    assert belief(sphere).contact == "auto"


def test_ids_become_integers(sphere):
    ids = belief(sphere, taxel_ids=[4.0, 2.0]).taxel_ids
    assert ids.tolist() == [4, 2]
    assert np.issubdtype(ids.dtype, np.integer)


def test_a_scene_without_noise_does_not_know_a_sigma(sphere):
    assert sphere.belief().noise_sigma is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"noise_sigma": 0.0}, "belief.noise_sigma is out of range, got 0 Pa, limit: above 0 Pa"),
        ({"saturation": 0}, "belief.saturation is out of range, got 0 Pa, limit: above 0 Pa"),
        ({"taxel_ids": [0.5, 1]}, "must be whole numbers, got 0.5"),
        ({"taxel_ids": [0, np.nan]}, "must be whole numbers, got nan"),
        ({"taxel_ids": [[0, 1]]}, r"must be a list, got shape \(1, 2\)"),
        ({"taxel_ids": "all"}, "must be numbers, got 'all'"),
        ({"taxel_ids": [3, 5, 3]}, "must be unique, got 3 2 times; list every taxel once"),
        ({"priors": {"modulus": 0.0}}, "prior of modulus is out of range, got 0, limit: above 0"),
        ({"priors": {"modulus": np.nan}}, "prior of modulus must be a finite number, got nan"),
        ({"priors": 3.0}, "priors of a belief must be a Mapping, got 3.0"),
        ({"headings": np.eye(4)}, r"must be rotation matrices, got shape \(4, 4\)"),
        ({"headings": 2.0 * np.eye(3)[None]}, "must be rotation matrices"),
        ({"headings": np.diag([1.0, 1.0, -1.0])[None]}, "rotation matrices.* without reflections"),
        ({"unknown": "gain"}, r'must be a list of names, got \'gain\'; write unknown=\("gain",\)'),
    ],
)
def test_a_field_out_of_range_is_refused(sphere, wrong, message):
    with pytest.raises(ConfigError, match=message):
        belief(sphere, **wrong)


def test_with_changes_fields_and_refuses_unknown_ones(sphere):
    belief = sphere.belief()
    assert belief.with_(contact="learned").contact == "learned"
    assert belief.contact == "hertz"
    with pytest.raises(ConfigError, match="contact"):
        belief.with_(contakt="learned")


def test_an_unknown_field_or_model_names_the_known_ones(sphere):
    with pytest.raises(UnknownNameError, match="unknown field 'noise' of a Belief; did you mean"):
        belief(sphere, noise=3.0)
    with pytest.raises(UnknownNameError, match="unknown contact model 'herz'; did you mean hertz"):
        belief(sphere, contact="herz")
