"""Devices that the operator holds to drive the robot: one module per way to hear of them."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "ros1": "runtime.teleoperators.ros1",
    "ros2": "runtime.teleoperators.ros2",
    "zmq": "runtime.teleoperators.zmq",
}
