"""Simulators of the user's own: five ways in, one contract, every run kept, slow ones emulated."""
