"""An SSH tunnel to a policy server: what a deployment says of it, its process, and the policy at its end."""
