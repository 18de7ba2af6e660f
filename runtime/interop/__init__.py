"""Files of other robotics programs: an episode as MCAP."""
