"""SSH tunnel to a policy server: settings, process, and the policy at its end."""
