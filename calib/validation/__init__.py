"""Predictions, scores, held-out rows, sensitivity, simulation-based calibration."""
