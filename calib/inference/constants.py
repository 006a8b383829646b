"""Tuned numbers of this room: unit; reason; the test that would notice a change."""

# Likelihood
HALF_LN_2PI = 0.9189385332046727  # nats; of a normal density; test_likelihood
CHUNK_CELLS = 200_000  # rows times vectors; bounds the memory; test_likelihood

# Search for modes
MODE_STARTS = 64  # points; finds modes of a tenth of the prior's width; test_modes
NEGLIGIBLE_NATS = 15.0  # nats below the highest mode, where no mass is; test_modes
SAME_MODE = 25.0  # squared standard distance of ascents to one mode; test_modes

# Proposal
ROUND_SIZES = (60, 120, 250, 400, 400, 400)  # draws per dimension + 5; test_proposal
GOOD_EFFICIENCY = 0.9  # better proposals are not worth a round; test_proposal
MOST_COMPONENTS = 6  # of a mixture about one mode; test_proposal
FITTED_DRAWS = 4000  # draws; a fit to more is no better; test_proposal
WIDENING = 1.07  # on scales; light tails cost more than heavy ones; test_sampler
BROAD_SHARE = (0.08, 0.4)  # of broad draws, if trusted and if not; test_sampler

# Sampler
ANNEALED = 512  # draws carried from the prior to the posterior; test_modes
LONG_DATA = 5000  # distinct rows that make an evaluation dear; benchmarks/million.py
JUDGED = 4096  # draws per ensemble that the gate looks at; test_sampler
PROPOSED = 0.85  # of steps that draw from the proposal, others are local; test_sampler
LEAST_LONGER = 1.25  # factor on the length of the next attempt; test_sampler
LEAST_STEPS = 32  # steps; of fewer, ESS comes out a tenth too large; test_sampler

# Estimators
FLAT_PART = 1e-6  # of the scatter; parameters that move less are held; test_least_squares
SHORT_DATA = 4000  # rows that show where an optimum is; benchmarks/million.py

# Files
MAX_CELLS = 8_000_000  # draws times rows of a group of posterior.nc, 64 MB; test_io

# Emulation
WORTH = 0.8  # of the allowed error; expected error at which it is checked; test_emulate
EDGE_WORTH = 0.3  # the same where some runs fail, twice in a row; test_reach
AMONG_FAILED = 0.5  # of draws next to a failed run; no value is known there; test_emulate
FORESEEN_FROM = 100  # runs that tell how many are needed; test_reach
NEGLIGIBLE = 0.01  # of the noise sd; smaller errors do not matter; test_emulate
WILD = 10.0  # ranges of other outputs; formulas may grow across zero; test_emulate
MOST_NODES = 160  # conditions of a run; test_nodes
PATIENCE = 5.0  # s until a trial says what it waits for; test_trial
SAME_OUTPUT = 1e-6  # relative; rounding of equal runs is less; test_trial
OTHER_UNIT = 30.0  # factor; kN and N differ by 1000; test_trial
