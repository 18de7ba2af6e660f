"""Exports of a plan's results: documents, tables, and the program that recomputes them."""
