"""Tuned numbers of this room: unit; reason; the test that would notice a change."""

# Likelihood
HALF_LN_2PI = 0.9189385332046727  # of a normal density
TILE_CELLS = (
    65_536  # rows times vectors; a few arrays of doubles in cache; tests/inference/likelihood
)
SHORT_TILE = 256  # rows that are one tile, in their order; tests/inference/likelihood
PARALLEL_CELLS = (
    4_000_000  # from which a second thread is worth starting; tests/inference/likelihood
)
CHUNK_CELLS = (
    200_000  # rows times vectors; bounds the memory of residuals; tests/inference/likelihood
)

# Search for modes
MODE_STARTS = 64  # points; finds a mode of 1/6 of the prior's width in 4 dimensions; test_modes
NEGLIGIBLE_NATS = 15.0  # nats below the highest mode; such a mode has no mass; test_modes
SAME_MODE = 25.0  # squared standard distance; ascents that end so near are of one mode; test_modes

# Proposal
ROUND_SIZES = (60, 120, 250, 400)  # draws per (dimension + 5) of each round; test_proposal
GOOD_EFFICIENCY = 0.9  # effective fraction; better proposals are not worth a round; test_proposal
MOST_COMPONENTS = 16  # of a mixture about one mode; test_proposal
FITTED_DRAWS = 6000  # draws; a fit to more is no better; test_proposal
WIDENING = 1.07  # factor on scales; light tails cost more than heavy ones; test_sampler
BROAD_SHARE = (0.08, 0.4)  # of draws from a broad component, trusted or not; test_sampler

# Sampler
ANNEALED = 512  # draws carried from the prior to the posterior; test_modes
LONG_DATA = 5000  # distinct rows from which an evaluation is dear; benchmarks/million.py
JUDGED = 4096  # draws per ensemble that the gate looks at; test_gate
LEAST_LONGER = 1.25  # factor on the length of the next attempt; test_sampler
LEAST_STEPS = 32  # steps among these: of fewer, ESS comes out too large by a tenth; test_gate

# Files
MAX_CELLS = 8_000_000  # draws times rows of a group of posterior.nc; 64 MB; test_io

# Estimators
FLAT_PART = (
    1e-6  # of the scatter; a parameter that moves less per prior sd is held; test_least_squares
)
SHORT_DATA = 4000  # rows that show where an optimum is; benchmarks/million.py

# Emulation
WORTH = 0.8  # of the allowed error; the expected error at which it is checked; test_emulate
EDGE_WORTH = 0.3  # the same where some runs fail, twice in a row; test_reach
AMONG_FAILED = 0.5  # of draws that are next to a failed run; beyond, no value is known; test_reach
FORESEEN_FROM = (
    100  # runs from which the course of the error tells how many are needed; test_emulate
)
NEGLIGIBLE = 0.01  # of the noise sd; smaller errors are not looked into; test_emulate
WILD = 10.0  # ranges of the other outputs; across zero a formula may grow beyond; test_reach
MOST_NODES = 160  # conditions of a run; test_nodes
PATIENCE = 5.0  # s after which a trial says what it waits for; test_trial
SAME_OUTPUT = 1e-6  # relative; rounding of equal runs is less; test_trial
OTHER_UNIT = 30.0  # factor; kN and N differ by 1000, ratio and percent by 100; test_trial
