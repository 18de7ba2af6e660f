"""The diagnostic bundle: how a lab is, in one file that can be sent on: no secrets, and blind for who is blind."""
