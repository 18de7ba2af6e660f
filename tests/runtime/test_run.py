from runtime.run import Run

BEGUN = {"ticks": 900, "missed": 2, "records_lost": 1, "lateness_p99_ms": 0.4}


def test_what_control_counts_is_counted_from_the_beginning_of_the_run():
    run = Run(1, "uuid", 0.0, counted=BEGUN)
    ended = {"ticks": 1200, "missed": 3, "records_lost": 1, "lateness_p99_ms": 0.2}
    assert run.figures(ended) == {"ticks": 300, "missed": 1, "records_lost": 0, "lateness_p99_ms": 0.2}


def test_a_control_that_was_restarted_meanwhile_counts_from_its_own_beginning():
    restarted = {"ticks": 40, "missed": 0, "records_lost": 0, "lateness_p99_ms": 0.2}
    assert Run(1, "uuid", 0.0, counted=BEGUN).figures(restarted) == restarted
