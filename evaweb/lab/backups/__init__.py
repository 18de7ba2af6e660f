"""Backups of a lab: consistent copies of database and data folder, with digests, verification and restore."""
