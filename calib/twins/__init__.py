"""Twins of blind cases, in which the effects act exactly as the diagnosis believes.

A twin has the design of a blind case, its kind of truth and its size of gap, but its readings are
drawn from the diagnosis's own formulas and priors. What the diagnosis still gets wrong there no
better formula would mend: it is what these designs cannot show. What it gets right on twins and
wrong on the cases themselves is what its formulas lack of the reality behind them.
"""

from calib.twins.make import make_twins

__all__ = ["make_twins"]
