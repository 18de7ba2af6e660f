import math

from runtime.clients.terminal import status_text
from tests.runtime.terminal_station import STATUS, status

ANSWERED = STATUS["policy"] | {
    "answers": 7,
    "latency_p50_ms": 81.6,
    "latency_p90_ms": 90.0,
    "delay_p50": 2.0,
    "delay_max": 4,
}


def test_the_line_of_a_run_says_how_it_is_going():
    running = status(
        "running",
        reason="",
        phase="executing",
        mode="step",
        run={"number": 1, "elapsed": 12.34},
        recording={"uuid": "u", "rows": 370},
        policy=ANSWERED,
        link={"rates": {"joints": 60.0, "cam_high": 30.1, "cam_low": 14.6}},
    )
    assert status_text.status_line(running) == (
        "RUNNING (step, executing)  12.3 s  370 rows  policy 82 ms, delay 2  tick p99 0.50 ms, 2 missed  "
        "cameras 15 Hz"
    )
    assert "SETTING_UP (warming up): set up" in status_text.status_line(
        status("setting_up", stage="warming up")
    )
    assert status_text.status_line(status("holding", reason="halted")).startswith(
        "HOLDING (continuous): halted  "
    )


def test_a_delay_that_is_not_known_yet_is_a_dash():
    assert "policy 82 ms, delay -" in status_text.status_line(
        status(policy=ANSWERED | {"delay_p50": math.nan})
    )


def test_a_lost_policy_is_said():
    lost = status("running", phase="executing", policy=ANSWERED | {"lost": True, "retry_in_s": 1.5})
    assert "policy lost" in status_text.status_line(lost)
    assert "LOST, asked again in 1.5 s" in "\n".join(status_text.status_report(lost, "me"))


def test_a_lease_is_named_where_somebody_else_holds_it():
    theirs = status(lease={"holder": "anna", "expires_in": 3.0})
    assert status_text.status_line(theirs, "me").endswith("  lease: anna")
    assert "lease" not in status_text.status_line(theirs)
    assert "lease" not in status_text.status_line(theirs, "anna")


def test_a_report_says_how_everything_is():
    first = {"distance": 0.42, "joint": "b", "far": True}
    told = status_text.status_report(
        status(policy=ANSWERED, first_action=first, drives={"enabled": False, "faults": ["hot"]}), "me"
    )
    assert told == [
        "READY: set up  policy 82 ms, delay 2  tick p99 0.50 ms, 2 missed",
        "  lease     free",
        "  robot     toy over zmq",
        "  drives    DISABLED; fault: hot",
        "  grippers  left 0.050 locked, right 0.100",
        "  task      fold",
        "  policy    openpi pi0; 7 answers, p50 82 ms, p90 90 ms; delay 2 ticks, at most 4",
        "  strategy  async, k_max none, blend_window 8",
        "  mode      continuous",
        "  first     the policy's first action is 0.420 rad away (b): FAR, approach it first",
        "  recording none",
        "  allowed   setup, run, estop",
    ]


def test_a_report_of_a_simulation_says_what_the_policy_sees_and_of_a_preview_what_is_shown():
    told = "\n".join(status_text.status_report(status("running", mode="sim", phase="executing"), "me"))
    assert "mode      sim, the policy sees the simulated state, executing" in told
    proposal = {"chunk": 3, "rows": 50, "distance": 0.1, "joint": "a", "far": False, "age_s": 2.0}
    told = "\n".join(
        status_text.status_report(
            status("running", mode="preview", phase="proposed", proposal=proposal), "me"
        )
    )
    assert "chunk     the chunk that is shown is 0.100 rad away (a)" in told


def test_drives_of_a_node_that_does_not_say_are_not_called_enabled():
    assert status_text.drive_line({}) == "not reported by the node"
    assert status_text.drive_line({"enabled": True, "faults": []}) == "enabled"


def test_a_lease_of_ones_own_and_a_warning_of_the_policy_are_said():
    mine = status(
        lease={"holder": "me", "expires_in": 4.2},
        policy=ANSWERED | {"rtc": {"warning": "the predicted delay does not fit"}},
    )
    told = "\n".join(status_text.status_report(mine, "me"))
    assert "lease     yours, for 4.2 s unless it is renewed" in told
    assert "; the predicted delay does not fit" in told


def test_parameters_that_mean_nothing_to_the_strategy_are_shown_only_when_asked_for():
    assert status_text.tuning_lines(status()) == ["async", "k_max none", "blend_window 8"]
    assert status_text.tuning_lines(status(), everything=True)[-1] == "ensemble_m 0.01 (nothing to async)"
