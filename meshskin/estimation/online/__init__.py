"""Calibration while contacts come in."""
