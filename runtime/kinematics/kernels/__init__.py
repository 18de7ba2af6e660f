"""Compiled loops of kinematics. They import numba, so import them only when a robot is built."""
