"""Backups of a lab: its database and its data folder at one moment, listed with digests, verified and put back."""
