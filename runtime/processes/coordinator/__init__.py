"""Coordinator process: commands, session, set-up, runs, and when to query the policy."""
