"""Results of an evaluation's trials: tables, comparisons, plots, reports."""
