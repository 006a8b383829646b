"""Rivals of the diagnosis, each by its published method, on the same cases as calib.

Each starts from the simulator as the laboratory calibrated it, sees the same rows, and writes its
answer in the form of `calib diagnose`: ``cd benchmarks && python -m rivals METHOD CASE OUT``.
"""
