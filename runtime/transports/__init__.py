"""Transports, one module per kind of link to a robot. Each declares `Config`, `capabilities`, `source` and `sink`."""

# Module of each kind. It is imported only if a deployment names it.
KINDS = {
    "dataset": "runtime.transports.dataset",
    "lerobot": "runtime.transports.lerobot",
    "ros1": "runtime.transports.ros1",
    "ros2": "runtime.transports.ros2",
    "zmq": "runtime.transports.zmq",
}
