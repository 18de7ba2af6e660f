"""Methods of docs/evaluation.md as pure functions: counts and outcomes in, estimates with intervals out.

Nothing here knows Django or a trial. numpy and scipy are imported when a function needs them, because pages that show
one proportion should not wait for scipy. Every function is deterministic: what draws at random takes a seed.
"""
