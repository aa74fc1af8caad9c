"""Uncertainty: observability, covariances, Cramer-Rao bound and tests of fit."""
