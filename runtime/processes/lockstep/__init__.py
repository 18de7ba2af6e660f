"""All processes in one, on a virtual clock."""
