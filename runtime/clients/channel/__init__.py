"""Control channel: JSON over ZMQ REQ/REP for scripts, in a process separate from those of the station."""
