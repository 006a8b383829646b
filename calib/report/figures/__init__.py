"""Figures of a result, each with one sentence on what it shows."""
