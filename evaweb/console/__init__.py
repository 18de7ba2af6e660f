"""The live page: what it shows and what it asks."""
