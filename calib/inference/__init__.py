"""Problem, likelihood, priors, estimators, sampling, convergence, and runs on disk."""
