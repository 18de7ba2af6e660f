"""Background jobs: rows that workers claim, execute and reclaim."""
