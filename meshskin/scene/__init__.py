"""The scene: what is simulated, its settings and files, and the belief that calibration gets."""
