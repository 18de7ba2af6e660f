"""The control channel: JSON over ZMQ REQ/REP for scripts, in a process of its own beside the family."""
