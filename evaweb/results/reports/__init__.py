"""Exports of a plan's results: documents, tables, the program that recomputes them."""
