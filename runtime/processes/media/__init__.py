"""Media, process 3: recordings and previews."""
