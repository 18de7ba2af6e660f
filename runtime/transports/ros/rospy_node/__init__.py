"""Program that another Python runs by its path; it is never imported."""
