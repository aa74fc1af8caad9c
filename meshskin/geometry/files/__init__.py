"""File formats of bodies and skins, one a module."""
