"""The report's sections on the paper."""
