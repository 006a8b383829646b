"""Measured cases: published tests of one laboratory that differ in one documented cause.

`data/` has the numbers, `cases/` which of them are laboratory and field, the simulator and the
documented cause, `SOURCES.md` where they are from. `python -m challenge.measured --out DIR`
diagnoses them through the program and marks what it wrote.
"""
