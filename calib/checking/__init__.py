"""Compute a report, a run or a comparison again from its own folder, and say what agrees."""
