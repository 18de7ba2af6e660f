"""Texts, lists and drawings of results, on pages and in reports."""
