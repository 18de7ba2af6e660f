"""The robot process: control loop, inference, recording, and the bus the web talks to."""
