"""The tuned numbers of the models and simulators."""

from __future__ import annotations

# Densities (g/cm3) between which the volumetric equation is solved; tests/models/test_properties.py
DENSITIES = (0.1, 5.0)
# Slip times length over modulus beyond which an elliptic contact's series is taken, off by 2e-13 at
# most, as 20 nodes are below; test_the_mobilised_part_of_an_elliptic_contact_is_bessel_and_struve
FAR_SLIP = 34.0
# Nodes on either half of a wheel's contact, which leave about 1e-6 of the load, and the entry
# angles (rad) among which it is looked for; tests/models/test_rigid_wheel.py
WHEEL_NODES = 8
ENTRY_ANGLES = (1e-4, 1.5)

# Simulators
# Characters kept of what a failed run printed, and bytes read of it; simulators/test_runner.py
TAIL_CHARACTERS = 600
END_BYTES = 4096
# s to wait for a killed process, which may hang in the kernel; simulators/test_runner.py
KILL_SECONDS = 5.0
# s of work from which starting processes pays off; simulators/test_runs.py
WORTH_SECONDS = 8.0
# If the first runs all fail, the file or the program is wrong: by chance this happens once in 32
# times at most if the simulator has values in half of its prior; tests/inference/emulation
FIRST_RUNS = 5
# Failed runs that are listed at most; tests/cli/test_simulators.py
LISTED_FAILURES = 200

# Emulators, coordinates being in sds of the prior; tests/models/simulators/test_emulator.py
# Points whose correlations are in memory at once.
AT_ONCE = 512
# Bounds of the length scales, and of the nugget relative to the process's variance: small, unless
# runs at one point differ.
LENGTHS = (0.2, 100.0)
NUGGETS, NUGGETS_NOISY = (1e-9, 1e-3), (1e-9, 1.0)
# Bounds of the length scales over conditions, in widths of the nodes' box; nuggets there, of which
# the smallest that gives a factor is taken.
NODE_LENGTHS = (0.03, 20.0)
NUGGETS_OVER = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8)
# Widths of the nodes' box by which curves are extrapolated, NaN beyond, and over which their slope
# is taken.
BEYOND_NODES = 0.15
STEP_INSIDE = 0.02
# Curves of the basis at most, and its truncation error over the negligible error, near the
# posterior and elsewhere.
MOST_CURVES = 14
LEFT_OUT = (1.0, 20.0)
# Runs from which the length scales over conditions are estimated, and runs in a region from which
# the basis is built for it.
LENGTH_RUNS = 12
FEW_RUNS = 8
# Prior sds beyond the successful runs within which the emulator has a value.
BEYOND_RUNS = 1.0
