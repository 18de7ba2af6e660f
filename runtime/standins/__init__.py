"""Stand-ins of other people's servers: policies of every protocol, and cameras."""
