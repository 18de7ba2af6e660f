"""Program for another Python, run by its path and never imported."""
