"""Helpers of command lines."""

from argparse import Namespace

import pytest

from meshskin.cli.options import given


@pytest.mark.parametrize("value", [0, 0.0, 3.0, "x", True, ["a"]])
def test_an_option_is_given_whatever_its_value(value):
    assert given(Namespace(force_n=value, other=None), ("force_n", "other")) == "--force-n"


@pytest.mark.parametrize("value", [None, False, []])
def test_an_option_that_is_not_given(value):
    assert given(Namespace(force_n=value), ("force_n", "missing")) == ""
