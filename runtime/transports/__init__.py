"""One file per way to a robot. Each declares `Config`, `capabilities`, `source` and `sink`."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "dataset": "runtime.transports.dataset",
    "ros1": "runtime.transports.ros1",
    "ros2": "runtime.transports.ros2",
    "zmq": "runtime.transports.zmq",
}
