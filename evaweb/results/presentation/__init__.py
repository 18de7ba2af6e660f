"""How results are worded, listed and drawn, on pages and in reports."""
