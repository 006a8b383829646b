"""The oracle: the best any method could do on a blind test, by one who knows how it was made.

It knows the generator: soil, tyre, noise, every mechanism with its variants and the rules by which
cases were drawn and thrown away. What it says is Bayes' theorem on that, so in expectation no
method names the truth first more often. It reads the sealed key and is part of the scoring.
"""
