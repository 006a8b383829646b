"""Emulation of slow simulators, run where a posterior needs them."""

from calib.inference.emulation.sequential import emulate
from calib.inference.emulation.settings import Emulation, EmulationSettings, HeldOut

__all__ = ["Emulation", "EmulationSettings", "HeldOut", "emulate"]
