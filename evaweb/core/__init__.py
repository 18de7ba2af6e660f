"""Ground of the web: errors, environment, files and text; no models."""
