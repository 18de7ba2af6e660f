"""Second ratings and preferences, and the judges' blindness."""
