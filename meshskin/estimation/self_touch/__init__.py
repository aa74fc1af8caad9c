"""Calibration of two skins of one robot from touches of one against the other."""
