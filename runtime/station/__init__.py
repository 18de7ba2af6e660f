"""One deployment with its robot, before anything is connected."""
