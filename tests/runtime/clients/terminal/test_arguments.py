import pytest

from runtime.clients.terminal.arguments import arguments
from runtime.clients.terminal.syntax import parse
from runtime.ipc.command_arguments import GripperRequest, RunRequest, SetUpRequest, TuneRequest


def said(*words):
    return arguments(parse(["bench-1", *words]))


@pytest.mark.parametrize("words", [["setup"], ["run"], ["step"], ["stop"], ["tune", "--show"]])
def test_what_was_not_said_stays_out(words):
    assert said(*words) == {}


@pytest.mark.parametrize(
    ("words", "expected", "model"),
    [
        (["setup", "--policy-url", "ws://a:1"], {"policy": {"url": "ws://a:1"}}, SetUpRequest),
        (["setup", "--policy", "kind=mock", "x=1"], {"policy": {"kind": "mock", "x": 1}}, SetUpRequest),
        (
            ["setup", "--task", "", "--strategy", "rtc", "--checkpoint", "c7", "--bench-seed", "3"],
            {
                "task": "",
                "strategy": {"kind": "rtc"},
                "checkpoint": {"id": "c7", "name": "c7"},
                "bench": {"seed": 3},
            },
            SetUpRequest,
        ),
        (
            ["run", "--mode", "sim", "--sim-state", "live", "--duration", "2.5", "--operator", "anna"],
            {"mode": "sim", "sim_state": "live", "duration_s": 2.5, "operator": "anna"},
            RunRequest,
        ),
        (["gripper", "open"], {"action": "open"}, GripperRequest),
        (["gripper", "lock", "--arm", "left"], {"action": "lock", "arm": "left"}, GripperRequest),
        (
            ["tune", "--strategy", "async", "--set", "k_max=none", "blend_window=4", "--task", "stack"],
            {"strategy": {"k_max": None, "blend_window": 4, "kind": "async"}, "task": "stack"},
            TuneRequest,
        ),
    ],
)
def test_what_was_said_is_what_the_station_reads(words, expected, model):
    assert said(*words) == expected
    model.model_validate(expected)
