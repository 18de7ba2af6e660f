"""Simulated bench with contact physics by MuJoCo: blocks are held, pushed and tipped by contact forces alone."""
