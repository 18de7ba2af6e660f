"""What every layer uses: types, clock, errors, settings, plug-ins, logs; knows no robot, station or process."""
