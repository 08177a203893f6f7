"""The Python APIs of other Gaussian rasterizers, one module each, on this package's core; see README.md here.

A module decides what is returned. None of them guesses it from its arguments.
"""
