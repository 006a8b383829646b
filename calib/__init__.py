"""Probabilistic calibration of tyre-soil models."""
