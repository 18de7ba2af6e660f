"""Stand-ins for external servers: policy servers of every protocol, and network cameras."""
