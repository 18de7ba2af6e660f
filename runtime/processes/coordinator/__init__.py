"""Process 2, decides: commands, session, set-up, runs, when the policy is asked."""
