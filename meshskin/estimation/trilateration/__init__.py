"""Trilateration: circles about contacts, and the displacements between taxels."""
