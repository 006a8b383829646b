"""The blind test: cases from wheel-soil mechanics with withheld answers, and their scoring.

This package is an independent reality, and a test bench: it is in the repository, not in the
wheel. Its data come from pressure-sinkage, shear and force balances, never from the formulas of
the models and effects that explain them; of `calib.gap` it knows the files and imports nothing.
`make.make` writes cases and a sealed key, `score.score` compares diagnoses with it, and
`redraw.redraw` writes the same designs with readings drawn by somebody else.
"""
