"""Skin: taxels on a body, their layouts, files and checks."""
