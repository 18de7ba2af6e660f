"""Bundled stand-ins: an execution node and policy servers, for trying things out and for tests."""
