"""Contact models and effects: from a force to the pressure that each taxel reads."""
