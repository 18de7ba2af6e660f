"""What a deployment file may say: schema, loader, reference."""
