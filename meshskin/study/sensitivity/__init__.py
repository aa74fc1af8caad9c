"""Sensitivity: what effects and numerical settings do to the error, and what they cost."""
