"""Leaders, i.e. devices that a person moves to drive the robot: one module per link."""

# Module of each kind. It is imported only if a deployment names it.
KINDS = {
    "lerobot": "runtime.teleoperators.lerobot",
    "ros1": "runtime.teleoperators.ros1",
    "ros2": "runtime.teleoperators.ros2",
    "zmq": "runtime.teleoperators.zmq",
}
