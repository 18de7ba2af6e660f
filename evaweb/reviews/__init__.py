"""Reviews of episodes: automatic quality checks, verdicts and notes of people, annotated segments, tags."""
