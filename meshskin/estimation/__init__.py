"""From a recording to a calibration: what it says, and how certain it is."""
