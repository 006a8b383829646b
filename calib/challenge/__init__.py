"""The blind test: cases from wheel-soil mechanics with withheld answers, and their scoring.

This package is an independent reality. Its data come from pressure-sinkage, shear and force
balances, never from the formulas of the models and effects that explain them, and it does not
import `calib.gap`. `make.make` writes cases and a sealed key, `score.score` compares diagnoses
with it.
"""
