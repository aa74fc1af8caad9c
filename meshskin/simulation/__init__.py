"""Simulation: the closed loop of arm, contact and compliance law, and the skin's readout."""
