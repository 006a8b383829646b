"""Figures of the paper's audit and gaps."""
