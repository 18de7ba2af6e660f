"""Blinding: who may see which checkpoint, and what pages and messages show to those who may not."""
