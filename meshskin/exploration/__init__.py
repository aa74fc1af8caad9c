"""Exploration: paths of the contact point over a skin, planned for the arm."""
