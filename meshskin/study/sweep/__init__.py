"""Parameter sweeps: cases, workers, results."""
