"""Gains of the law and speeds of the exploration, chosen by optimal control."""
