"""Accuracy against time: knobs and their levels, and four questions about them.

`budget` (what may be left out for a taxel error), `cost` (error and seconds of every level), and a
run for an accuracy or for a time (request, pilot).
"""
