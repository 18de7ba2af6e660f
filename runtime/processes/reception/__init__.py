"""Reception, process 5: receives every observation and puts it into shared state."""
