"""Second ratings, preferences and automatic judgements, and the blinding of raters."""
