"""Sampling with emcee: mode, proposal, moves, gate, sampler."""
