"""Exploration: where the contact point goes, planned for the arm."""
