"""Tuned numbers of this room: unit; reason; the test that would notice a change, if any.

Numbers that are used once stand where they are used.
"""

HALF_LN_2PI = 0.9189385332046727  # nats; of a normal density; test_likelihood
CHUNK_CELLS = 200_000  # rows times vectors; bounds the memory; test_likelihood
ROUND_SIZES = (60, 120, 250, 400, 400, 400)  # draws per dimension + 5; test_proposal
JUDGED = 4096  # draws per ensemble that the gate looks at; test_sampler
# Share of the steps that draw from the proposal; the rest are local, for where it fits badly. At
# 0.5, chains need up to twice as many steps for the same posterior. test_sampler notices only 0.
PROPOSED = 0.85

# Emulation
FORESEEN_FROM = 100  # runs that tell how many are needed; test_emulate
NEGLIGIBLE = 0.01  # of the noise sd; smaller errors do not matter; test_emulate
PATIENCE = 5.0  # s until a trial says what it waits for; test_trial
SAME_OUTPUT = 1e-6  # relative; rounding of equal runs is less; test_trial
