"""Preflight: a query to a policy without a robot, from the deployment to action rows that a robot could execute."""
