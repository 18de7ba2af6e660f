"""Preflight: a policy asked without a robot, from the deployment to action rows that a robot could execute."""
