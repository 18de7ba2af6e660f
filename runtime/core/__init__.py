"""Basis of every layer: types, clock, errors, settings, plug-ins, logs; knows no robot, station, process."""
