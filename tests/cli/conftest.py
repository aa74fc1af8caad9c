"""What tests of several commands share."""

import pytest

from meshskin.report import figure_set


@pytest.fixture
def no_figures(monkeypatch):
    """Pages have no figures: drawing takes most of the time of a command that writes a page, and
    has tests of its own."""
    monkeypatch.setattr(figure_set, "DRAWN", ())
