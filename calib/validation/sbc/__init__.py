"""Simulation-based calibration: whether posteriors and bands are right where the truth is known.

Parameters are drawn from the prior, data from the parameters, and the posterior of those data is
sampled exactly as a user's would be. If prior, likelihood and sampler agree, the rank of the truth
among posterior draws is uniform for every quantity [1]_ [2]_.

References
----------
.. [1] Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788.
.. [2] Modrak, Moon, Kim, Buerkner, Huurre, Faltejskova, Gelman & Vehtari (2023),
   doi:10.1214/23-BA1404.
"""
