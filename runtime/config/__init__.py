"""Contents of a deployment file: schema, loader, reference."""
