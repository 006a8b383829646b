"""Compute a report or a run again from its own folder, and say of everything whether it agrees.

`schema` reads what a folder says of itself, `inputs` holds it against the hashes, `recompute` does
the work again, `tolerances` say how far chance may move each number, `numbers`, `figures`,
`posteriors` and `text` compare, and `check` ties it together.
"""
