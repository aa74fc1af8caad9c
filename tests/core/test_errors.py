"""Messages of errors."""

from meshskin.core.errors import UnknownNameError


def test_a_long_list_of_known_names_is_cut():
    names = [f"link_{k}" for k in range(300)]
    assert len(str(UnknownNameError("link", "?", names))) < 600
    assert "and 260 more" in str(UnknownNameError("link", "?", names))
