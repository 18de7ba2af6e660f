"""What the trials of an evaluation say: tables, comparisons, plots, reports."""
