"""A policy asked without a robot: what is found on the way from a deployment to rows that a robot could execute."""
