"""A program for another Python, run by its path; nothing here is imported."""
