"""Slow simulators, emulated: processes over parameters, a reduced basis over conditions."""

from calib.models.simulators.emulator.emulator import Axes, Emulator, Training, build_emulator

__all__ = ["Axes", "Emulator", "Training", "build_emulator"]
