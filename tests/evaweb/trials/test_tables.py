import pytest
from django.core.exceptions import ValidationError

from evaweb.trials.tables import (
    check_bench,
    check_bench_name,
    check_policy,
    check_strategy,
    example_layout,
    layout_problems,
    simulated_bench,
)
from runtime.benches.schema import load_schema

KEY = "-----BEGIN OPENSSH PRIVATE KEY-----\nc2VjcmV0\n"


@pytest.mark.parametrize(
    "policy",
    [
        {},
        {"url": "ws://10.0.0.1:8000"},
        {"kind": "openpi", "image_size": [224, 224]},
        {"kind": "mock"},
        {
            "tunnel": {
                "host": "gpu-1.lab",
                "user": "lab",
                "identity_file": "~/.ssh/id_lab",
                "jump": ["gate.lab"],
            }
        },
        {"kind": "gr00t", "tunnel": {"user": "lab"}},  # its host is the deployment's
        {"tunnel": None},  # the deployment's is not for this one
    ],
)
def test_policies_that_a_deployment_could_have_pass(policy):
    check_policy(policy)


@pytest.mark.parametrize(
    ("policy", "sentence"),
    [
        ([], "allowed: a table such as"),
        ("ws://10.0.0.1", "allowed: a table such as"),
        ({"kind": "gpt"}, "kind = 'gpt'; allowed: gr00t, lerobot, mock, openpi"),
        ({"kind": "openpi", "urll": "x"}, "urll: unknown key for kind 'openpi'; allowed: "),
        ({"kind": "openpi", "url": "http://x"}, "url = 'http://x': "),
        ({"nonsense": 1}, "nonsense: unknown key"),
        ({"uri": "ws://10.0.0.1:8000"}, "uri: unknown key for kind 'openpi'; allowed: "),
        ({"image_size": [224]}, "image_size = [224]: "),
        (
            {"tunnel": {"host": "-oProxyCommand=id"}},
            "tunnel.host = '-oProxyCommand=id': must be a host's name",
        ),
        (
            {"tunnel": {"hosts": "gpu"}},
            "tunnel.hosts: unknown key for kind 'openpi'; allowed: host, user, port",
        ),
        ({"kind": "mock", "tunnel": {"host": "gpu"}}, "tunnel: unknown key for kind 'mock'"),
        (
            {"tunnel": {"host": "gpu", "identity_file": KEY}},
            "tunnel.identity_file: must be the path of a file",
        ),
        ({"amplitud": 0.1}, "amplitud: unknown key for kind 'mock'; allowed: kind, amplitude"),
    ],
)
def test_other_policies_are_refused_with_what_is_allowed(policy, sentence):
    with pytest.raises(ValidationError) as refused:
        check_policy(policy)
    assert sentence in " ".join(refused.value.messages)


def test_nothing_of_a_key_is_shown_again():
    with pytest.raises(ValidationError) as refused:
        check_policy(
            {"kind": "openpi", "tunnel": {"host": "gpu", "identity_file": KEY, "password": "c2VjcmV0"}}
        )
    said = " ".join(refused.value.messages)
    assert "tunnel.password: unknown key" in said
    assert "PRIVATE KEY" not in said
    assert "c2VjcmV0" not in said


@pytest.mark.parametrize(
    "bench",
    [
        None,
        {},
        {"block": [0.1, 0.3, 45]},
        {"block": [0, 0, 0], "plate": [-0.1, 0.3]},
        {"plate": [-0.1, 0.3], "objects": {"red cup": [0.1, 0.3, -90, 0.08, 0.08]}},
    ],
)
def test_benches_that_can_be_pass(bench):
    check_bench(bench)


@pytest.mark.parametrize(
    ("bench", "sentence"),
    [
        ([1], "allowed: a table such as"),
        ({"objects": [1]}, "objects = [1]; allowed: a table such as"),
        (
            {"objects": {"cup": [0, 0]}},
            "cup = [0, 0]; allowed: 5 numbers: [x, y, yaw in degrees, width, depth]",
        ),
        ({"objects": {"cup": [0, 0, 0, 0, 0.1]}}, "width and depth from 0.005 to 1.0 metres"),
        ({"objects": {"a/b": [0, 0, 0, 0.1, 0.1]}}, "allowed: a name of an object"),
    ],
)
def test_other_benches_are_refused_with_what_is_allowed(bench, sentence):
    with pytest.raises(ValidationError) as refused:
        check_bench(bench)
    assert sentence in " ".join(refused.value.messages)


@pytest.mark.parametrize(
    ("bench", "sentence"),
    [
        ({"cup": [0, 0]}, "cup: unknown key; allowed: plate, block, objects"),
        ({"block": [0, 0]}, "block = [0, 0]; allowed: 3 numbers: [x, y, yaw in degrees]"),
        ({"plate": [0, "a"]}, "allowed: 2 numbers"),
        ({"plate": [0, True]}, "allowed: 2 numbers"),
        ({"plate": [0, float("nan")]}, "allowed: 2 numbers"),
        ({"plate": 3}, "allowed: 2 numbers"),
        ({"plate": [300, 0]}, "at most 2 from the middle"),
        ({"factors": {"wind": 1}}, "factors.wind: unknown factor"),
        ({"red_1": [0, 0.3, 0]}, "red_1: unknown key"),
        ({"factors": [1]}, ""),  # what the field's own check refuses
    ],
)
def test_a_layout_is_compared_with_one_simulated_bench(bench, sentence):
    found = layout_problems(bench, load_schema("tabletop"))
    assert sentence in " ".join(found) if sentence else found == []


def test_another_bench_has_other_objects():
    assert layout_problems({"red_1": [0, 0.3, 0], "blue_bin": [-0.08, 0.22]}, load_schema("sorting")) == []
    check_bench_name("sorting")
    with pytest.raises(ValidationError, match="allowed: aloha, metaworld, sorting, tabletop, or the path"):
        check_bench_name("moon")


def test_a_bench_with_a_program_of_its_own_has_choices_and_no_objects():
    schema = load_schema("metaworld")
    assert example_layout(schema) == {"choices": {"task": "reach-v3", "pictures": "as published"}}
    assert layout_problems({"choices": {"task": "door-open-v3"}}, schema) == []
    assert layout_problems({"choices": {"task": "door-open-v2"}, "block": [0, 0, 0]}, schema) == [
        "block: unknown key; allowed: objects, factors, choices",
        "choices.task = 'door-open-v2'; allowed: door-open-v3, door-close-v3, window-open-v3, drawer-open-v3, "
        "door-lock-v3 and 45 more",
    ]
    with pytest.raises(ValidationError, match="choices = 3; allowed: a table"):
        check_bench({"choices": 3})


def test_a_simulated_bench_lays_what_is_its_own():
    laid = {"block": [0.1, 0.3, 45], "plate": [-0.1, 0.3]}
    assert simulated_bench({**laid, "objects": {"cup": [0, 0, 0, 0.1, 0.1]}}) == laid
    assert simulated_bench(None) is None


@pytest.mark.parametrize(
    "strategy", [None, {}, {"kind": "rtc", "inference_rate": 5}, {"blend_window": "all"}]
)
def test_strategies_that_a_deployment_could_have_pass(strategy):
    check_strategy(strategy)


@pytest.mark.parametrize(
    ("strategy", "sentence"),
    [
        ({"kind": "asink"}, "kind = 'asink'; allowed: ensemble, naive, async, rtc, sync"),
        ({"kind": ["rtc"]}, "kind = ['rtc']; allowed: ensemble, naive, async, rtc, sync"),
        ({"inference_rate": 0}, "inference_rate = 0: Input should be greater than 0"),
        ({"kind": "sync", "rate": 5}, "rate: unknown key for kind 'sync'"),
        ("rtc", """'rtc'; allowed: a table such as {"kind": "rtc", "inference_rate": 5}"""),
    ],
)
def test_other_strategies_are_refused_with_what_is_allowed(strategy, sentence):
    with pytest.raises(ValidationError) as refused:
        check_strategy(strategy)
    assert sentence in refused.value.messages[0]
