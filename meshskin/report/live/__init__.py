"""The live page: an exploration in the browser while it is calibrated online."""
