"""Compiled loops of kinematics; importing one of them imports numba, so nothing does before a robot is built."""
