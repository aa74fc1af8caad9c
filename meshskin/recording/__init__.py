"""The recording: what a simulation or a robot writes, and what calibration reads."""
