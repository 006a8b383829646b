"""The tuned numbers of the models and simulators; those used once stand where they are used."""

from __future__ import annotations

# Slip times length over modulus beyond which an elliptic contact's series is taken, off by 2e-13 at
# most, as 20 nodes are below; test_the_mobilised_part_of_an_elliptic_contact_is_bessel_and_struve
FAR_SLIP = 34.0

# Simulators
# Characters kept of what a failed run printed, and bytes read of it; simulators/test_runner.py
TAIL_CHARACTERS = 600
END_BYTES = 4096
# s to wait for a killed process, which may hang in the kernel; simulators/test_runner.py
KILL_SECONDS = 5.0
# If the first runs all fail, the file or the program is wrong: by chance this happens once in 32
# times at most if the simulator has values in half of its prior; tests/inference/emulation
FIRST_RUNS = 5
# Of an FMU in one process; some stop after 1030 (CATIA-Systems/FMPy#608); simulators/test_fmu.py
FMU_CALLS = 500

# Emulators; tests/models/simulators/test_emulator.py
# Nuggets over conditions, of which the smallest that gives a factor is taken.
NUGGETS_OVER = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8)
# Widths of the nodes' box by which curves are extrapolated, NaN beyond, and over which their slope
# is taken.
BEYOND_NODES = 0.15
STEP_INSIDE = 0.02
# Prior sds beyond the successful runs within which the emulator has a value.
BEYOND_RUNS = 1.0
