"""Simulators of the user's own: four ways in, one contract, every run kept, slow ones emulated."""
