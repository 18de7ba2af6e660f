"""Base layer of the runtime: types, clock, errors, settings, plug-ins, logs; independent of robots and stations."""
