"""Statistical methods of docs/evaluation.md as pure functions: counts and outcomes in, estimates with intervals out.

The package depends neither on Django nor on the models of trials. numpy and scipy are imported inside the functions
that need them, because pages that show one proportion should not wait for scipy. Every function is deterministic:
functions that draw random numbers have a `seed` argument or a fixed seed.
"""
