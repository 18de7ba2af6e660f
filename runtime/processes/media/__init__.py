"""Process 3, records and previews."""
