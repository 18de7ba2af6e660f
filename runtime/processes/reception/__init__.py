"""Process 5, receives every observation and puts it where the others find it."""
