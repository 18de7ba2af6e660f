"""Records that are only ever added to: guarded tables and journals on the disk."""
