"""Keeping a map: what a few touches say of an earlier calibration."""
