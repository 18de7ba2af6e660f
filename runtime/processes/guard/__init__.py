"""Process 4, the e-stop."""
