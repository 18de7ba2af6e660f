import json
import math
import random
import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from runtime.config import loader
from runtime.config.collection import CollectionSettings
from runtime.config.loader import load
from runtime.config.schema import Deployment
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.core.settings import Settings
from runtime.station.checks import check_deployment
from tests.runtime.lerobot.fake_lerobot import FakeLerobot

DEPLOYMENTS = Path(__file__).parents[3] / "deployments"
SMALL = """\
station = "bench"
robot = "r"

[transport]
kind = "zmq"

[policy]
kind = "mock"
"""


@pytest.fixture
def write(tmp_path):
    def write(content=SMALL, name="bench.toml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, "utf-8")
        return path

    return write


@pytest.fixture
def small(write):
    return write()


def refusal(path, *assignments):
    with pytest.raises(ConfigurationError) as caught:
        load(path, assignments)
    return str(caught.value)


# --- what a file may say -----------------------------------------------------------------------------------


def test_a_small_file_is_enough(small):
    found = load(small).deployment
    assert (found.station, found.transport.kind, found.policy.kind) == ("bench", "zmq", "mock")
    assert (found.strategy.kind, found.strategy.blend_window) == ("async", 8)
    assert (found.lease.ttl_s, found.safety.joint_age_s, found.control.orphan_hold_s) == (5.0, 0.2, 5.0)


def test_every_variant_of_every_part_can_be_chosen_by_its_kind():
    parts = {
        "transport": "runtime.transports",
        "policy": "runtime.policies",
        "strategy": "runtime.strategies",
    }
    for part, package in parts.items():
        for kind, module in variants(package).items():
            tree = {
                "station": "bench",
                "robot": "r",
                "transport": {"kind": "zmq"},
                "policy": {"kind": "mock"},
                "collection": {"source": "node"},
                part: {"kind": kind},
            }
            try:
                chosen = getattr(Deployment.model_validate(tree), part)
            except ValidationError as invalid:  # of a kind that cannot do without further keys
                errors = invalid.errors()
                assert {error["loc"][0] for error in errors} == {part}
                assert {error["type"] for error in errors} == {"missing"}
            else:
                assert type(chosen) is module.Config


def test_a_deployment_cannot_be_changed_after_it_was_loaded(small):
    found = load(small).deployment
    with pytest.raises(ValueError, match="frozen"):
        found.station = "other"
    with pytest.raises(ValueError, match="frozen"):
        found.safety.jump = 9.0


def test_the_data_folder_is_given_or_comes_from_the_environment_or_is_here(small, monkeypatch, tmp_path):
    monkeypatch.setenv("EVA_DATA_DIR", "/var/eva")
    assert load(small, [f"data_dir={tmp_path}"]).deployment.data == tmp_path
    found = load(small).deployment
    assert found.station_dir == Path("/var/eva/stations/bench")
    assert found.episodes_dir == Path("/var/eva/episodes")
    monkeypatch.delenv("EVA_DATA_DIR")
    assert found.data == Path.cwd() / "data"


# --- extends -----------------------------------------------------------------------------------------------


def test_a_file_starts_from_another_table_by_table(write, small):
    write('[control]\nrate = 50\nrealtime = "off"\n[safety]\njump = 0.1\n', "base.toml")
    write('extends = "base.toml"\n' + SMALL + "[control]\nrate = 100\n", "middle.toml")
    top = write('extends = "middle.toml"\ntask = "wave"\n', "top.toml")
    found = load(top).deployment
    assert (found.control.rate, found.control.realtime, found.safety.jump) == (100, "off", 0.1)
    assert (found.station, found.task) == ("bench", "wave")


def test_the_file_it_starts_from_is_looked_for_beside_it(write):
    write(SMALL, "common/base.toml")
    top = write('extends = "../common/base.toml"\nstation = "arm"\n', "stations/top.toml")
    assert load(top).deployment.station == "arm"


def test_a_table_of_another_kind_replaces_the_old_one_whole(write):
    write(SMALL + '[strategy]\nkind = "async"\nblend_window = 4\n', "base.toml")
    top = write('extends = "base.toml"\n[strategy]\nkind = "sync"\nexecution_horizon = 5\n', "top.toml")
    found = load(top).deployment.strategy
    assert (found.kind, found.execution_horizon) == ("sync", 5)


def test_a_table_of_the_same_kind_is_merged(write):
    write(SMALL + '[strategy]\nkind = "async"\nblend_window = 4\n', "base.toml")
    top = write('extends = "base.toml"\n[strategy]\nkind = "async"\nk_max = 3\n', "top.toml")
    assert (load(top).deployment.strategy.blend_window, load(top).deployment.strategy.k_max) == (4, 3)


@pytest.mark.parametrize("chain", [["a.toml"], ["b.toml", "a.toml"], ["b.toml", "c.toml", "a.toml"]])
def test_a_circle_is_an_error_that_names_it(write, chain):
    paths = [
        write(f'extends = "{nxt}"\n', name) for name, nxt in zip(["a.toml", *chain], chain, strict=False)
    ]
    message = refusal(paths[0])
    assert message.startswith(f"{paths[0]}: extends itself by way of {paths[0]}")
    assert all(str(path) in message for path in paths)


def test_a_circle_is_found_however_it_is_written(write):
    top = write('extends = "../common/a.toml"\n', "common/a.toml")
    assert "extends itself by way of" in refusal(top)


def test_a_file_that_is_missing_is_named_with_those_that_are_there(write, small, tmp_path):
    message = refusal(tmp_path / "bensh.toml")
    assert message == (
        f"{tmp_path}/bensh.toml: cannot be read (No such file or directory); "
        "deployment files there: bench.toml"
    )
    top = write('extends = "base.toml"\n', "top.toml")
    assert f"{tmp_path}/base.toml: which {top} extends cannot be read" in refusal(top)


def test_extends_must_be_a_name(write):
    path = write("extends = 3\n")
    assert refusal(path) == f"{path}: extends = 3: must be the name of another file"


@pytest.mark.parametrize("content", [b"station = \n", b"a = 1\na = 2\n", b"\xff"])
def test_what_is_no_toml_is_an_error_that_names_the_file(tmp_path, content):
    path = tmp_path / "bench.toml"
    path.write_bytes(content)
    assert refusal(path).startswith(f"{path}: is not valid TOML: ")


# --- --set -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignment", "key", "value"),
    [
        ("control.rate=50", "control.rate", 50),
        ("control.rate=12.5", "control.rate", 12.5),
        (" run.duration_s = 8", "run.duration_s", 8),
        ("setup.home=false", "setup.home", False),
        ("task=wave both arms", "task", "wave both arms"),
        ('task="quoted"', "task", "quoted"),
        ("task=a=b", "task", "a=b"),
        ("task=", "task", ""),
        ("strategy.kind=sync", "strategy.kind", "sync"),
        ("transport.disabled_cameras=['a', 'b']", "transport.disabled_cameras", ["a", "b"]),
        ("policy.amplitude=0.1", "policy.amplitude", 0.1),
        ("policy={kind='mock', horizon=3}", "policy.horizon", 3),
        ("transport.sub_endpoint=tcp://127.0.0.1:9", "transport.sub_endpoint", "tcp://127.0.0.1:9"),
    ],
)
def test_any_key_can_be_set_on_the_command_line(small, assignment, key, value):
    found = load(small, [assignment]).deployment
    for name in key.split("."):
        found = getattr(found, name)
    assert found == value


def test_a_box_can_be_set_arm_by_arm(small):
    found = load(small, ["safety.workspace.left.lower=[0,0,0]", "safety.workspace.left.upper=[1,1,1]"])
    assert found.deployment.safety.workspace["left"].upper == [1, 1, 1]


def test_the_last_of_two_assignments_counts(small):
    assert load(small, ["control.rate=50", "control.rate=60"]).deployment.control.rate == 60


def test_another_kind_on_the_command_line_drops_the_settings_of_the_old_kind(write):
    path = write(SMALL + '[strategy]\nkind = "async"\nblend_window = 4\n')
    assert load(path, ["strategy.kind=sync"]).deployment.strategy.kind == "sync"


def test_a_kind_does_not_undo_what_is_set_before_it(write):
    path = write(SMALL + '[strategy]\nkind = "async"\nblend_window = 4\n')
    found = load(path, ["strategy.execution_horizon=7", "strategy.kind=sync"]).deployment.strategy
    assert (found.kind, found.execution_horizon) == ("sync", 7)


@pytest.mark.parametrize("assignment", ["control.rate", "=30", " =30", ""])
def test_an_assignment_without_key_or_value_is_refused_with_an_example(small, assignment):
    assert refusal(small, assignment) == (
        f"--set {assignment}: must be key=value, for example control.rate=30"
    )


def test_a_key_below_something_that_is_no_table_is_refused(small):
    assert refusal(small, "station.name=x") == "--set station.name=x: station is not a table"


# --- errors name file, key, value and what is allowed ------------------------------------------------------


def test_an_unknown_key_is_named_with_its_file_and_what_is_allowed(write):
    path = write(SMALL + "[control]\nrat = 30\n")
    assert refusal(path) == (
        f"{path}: control.rat = 30: unknown key (did you mean rate?); allowed here: "
        "coordinator_timeout_s, heartbeat_timeout_s, orphan_hold_s, rate, realtime, realtime_priority, "
        "starvation_hold_s"
    )


def test_an_unknown_key_of_a_variant_is_told_the_keys_of_that_variant(small):
    message = refusal(small, "policy.url=ws://x")
    assert message.startswith("--set policy.url=ws://x: policy.url = 'ws://x': unknown key; allowed here: ")
    assert message.endswith("amplitude, horizon, kind, latency_s, period_s")


def test_an_unknown_key_deep_in_a_variant_is_told_the_keys_of_that_table(small):
    message = refusal(small, "transport.kind=dataset", "transport.path=x", "transport.mapping.stat=y")
    assert "transport.mapping.stat = 'y': unknown key (did you mean state?); allowed here: action" in message


def test_an_unknown_key_in_a_table_of_names_is_told_the_keys_of_that_table(small):
    box = ["safety.workspace.left.lower=[0,0,0]", "safety.workspace.left.upper=[1,1,1]"]
    message = refusal(small, *box, "safety.workspace.left.low=0")
    assert message.endswith(
        "safety.workspace.left.low = 0: unknown key (did you mean lower?); allowed here: lower, upper"
    )


def test_an_unknown_table_is_an_unknown_key(small):
    message = refusal(small, "contol.rate=30")
    assert message.startswith(
        "--set contol.rate=30: contol = {'rate': 30}: unknown key (did you mean control?)"
    )


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        ("control.rate='30'", "control.rate = '30': Input should be a valid number"),
        ("control.rate=true", "control.rate = True: Input should be a valid number"),
        ("control.rate=0", "control.rate = 0: Input should be greater than 0"),
        ("control.rate=1001", "control.rate = 1001: Input should be less than or equal to 1000"),
        ("control.realtime=on", "control.realtime = 'on': Input should be 'auto' or 'off'"),
        ("setup.warmup_chunks=1.5", "setup.warmup_chunks = 1.5: Input should be a valid integer"),
        ("setup.home=1", "setup.home = 1: Input should be a valid boolean"),
        ("task=3", "task = 3: Input should be a valid string"),
        ("station=a/b", "station = 'a/b': String should match pattern"),
        ("station=..", "station = '..': String should match pattern"),
        ("control=5", "control = 5: must be a table"),
        ("policy=mock", "policy = 'mock': must be a table"),
        ("bus.host=0.0.0.0", "bus.host = '0.0.0.0': the bus has no ports any more, but Unix sockets"),
        ("bus.estop_port=5", "bus.estop_port = 5: the bus has no ports any more, but Unix sockets"),
        (
            "policy.kind=mok",
            "policy.kind = 'mok': must be one of 'external', 'gr00t', 'lerobot', 'mock', 'none', 'openpi', 'replay'",
        ),
        (
            "policy.kind=5",
            "policy.kind = 5: must be one of 'external', 'gr00t', 'lerobot', 'mock', 'none', 'openpi', 'replay'",
        ),
        (
            "policy={horizon=3}",
            "policy.kind is missing: must be one of 'external', 'gr00t', 'lerobot', 'mock', 'none', 'openpi', 'replay'",
        ),
        (
            "strategy={kind=['sync']}",
            "strategy.kind = ['sync']: must be one of 'ensemble', 'naive', 'async', 'rtc', 'sync'",
        ),
        ("safety.workspace=3", "safety.workspace = 3: must be a table"),
        ("policy.horizon=x", "policy.horizon = 'x': Input should be a valid integer"),
    ],
)
def test_a_wrong_value_is_named_with_its_key_and_what_is_allowed(small, assignment, sentence):
    assert refusal(small, assignment).startswith(f"--set {assignment}: {sentence}")


@pytest.mark.parametrize("number", ["nan", "inf"])
@pytest.mark.parametrize(
    "key", ["safety.following_error", "safety.joint_age_s", "lease.ttl_s", "policy.period_s"]
)
def test_a_limit_that_is_no_limit_is_refused(small, key, number):
    assert f"{key} = {number}: Input should be" in refusal(small, f"{key}={number}")


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_a_box_without_a_wall_is_refused(small, number):
    message = refusal(
        small, f"safety.workspace.left.lower=[0,0,{number}]", "safety.workspace.left.upper=[1,1,1]"
    )
    assert "safety.workspace.left.lower.2" in message
    assert "Input should be a finite number" in message


def _numbers(section, path=""):
    for name, field in section.model_fields.items():
        if field.annotation in (float, float | None):
            yield section, name
        elif isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            yield from _numbers(field.annotation, name)


@pytest.mark.parametrize(
    ("section", "name"),
    [
        *_numbers(Deployment),
        *(
            number
            for package in ("runtime.transports", "runtime.policies", "runtime.strategies")
            for module in variants(package).values()
            for number in _numbers(module.Config)
        ),
    ],
)
def test_no_number_of_any_section_may_be_infinite(section, name):
    with pytest.raises(ValueError, match=f"(?s){name}.*(finite number|less than or equal)"):
        section.model_validate({name: math.inf})


def test_a_missing_key_is_named(write):
    path = write(SMALL.replace('robot = "r"\n', ""))
    assert refusal(path) == f"{path}: robot is missing and has no default"


def test_a_missing_key_of_a_variant_is_named(small):
    assert refusal(small, "policy.kind=replay").endswith("policy.path is missing and has no default")


def test_all_errors_are_told_at_once(small):
    lines = refusal(small, "control.rate=-1", "task=3", "foo=1").splitlines()
    assert {line.split(": ")[1].split(" ")[0] for line in lines} == {"control.rate", "task", "foo"}


def test_an_error_in_a_file_below_names_that_file(write):
    base = write(SMALL + "[control]\nrate = -1\n", "base.toml")
    top = write('extends = "base.toml"\n[setup]\nhome = 3\n', "top.toml")
    lines = refusal(top).splitlines()
    assert f"{base}: control.rate = -1: Input should be greater than 0" in lines
    assert f"{top}: setup.home = 3: Input should be a valid boolean" in lines


def test_an_error_that_a_part_finds_itself_names_the_file_too(small):
    assert refusal(small, "transport.sub_endpoint=tcp://10.0.0.7:5555").startswith(
        f"{small}: transport.sub_endpoint = 'tcp://10.0.0.7:5555' leaves this machine over a plain link"
    )


# --- the hash ----------------------------------------------------------------------------------------------


def shuffled(tree, seed):
    keys = list(tree)
    random.Random(seed).shuffle(keys)
    return {key: shuffled(tree[key], seed) if isinstance(tree[key], dict) else tree[key] for key in keys}


def test_the_hash_does_not_depend_on_where_or_in_what_order_a_key_stands(write, small):
    write(SMALL.replace('"bench"', '"other"') + "[control]\nrate = 7\n", "base.toml")
    top = write('extends = "base.toml"\nstation = "bench"\n[control]\nrate = 30\n', "top.toml")
    digest = load(top).digest
    assert load(small, ["control.rate=30.0"]).digest == digest
    tree = dict(load(top).tree)
    for seed in range(5):
        assert loader.resolve_deployment(shuffled(tree, seed), {}, "x").digest == digest


def test_a_default_that_is_written_out_is_the_same_deployment(small):
    assert load(small).digest == load(small, ["safety.jump=0.5", "lease.ttl_s=5.0"]).digest


@pytest.mark.parametrize(
    "assignment",
    ["task=wave", "safety.jump=0.4", "strategy.kind=sync", "policy.horizon=7", "control.rate=31"],
)
def test_the_hash_changes_with_the_deployment(small, assignment):
    assert load(small).digest != load(small, [assignment]).digest


# --- the files that come with it ---------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(DEPLOYMENTS.glob("*.toml")), ids=lambda path: path.name)
def test_every_deployment_that_comes_with_it_loads_and_survives_the_way_to_the_family(path, tmp_path):
    needed = {
        "base.toml": ["robot=r", "transport.kind=zmq", "policy.kind=mock"],
        "replay_dataset.toml": [f"transport.path={tmp_path}", f"policy.path={tmp_path}"],
        "so101.toml": [f'transport.python="{FakeLerobot(tmp_path).python}"'],
    }
    resolved = load(path, needed.get(path.name, []))
    handed_over = json.loads(json.dumps(dict(resolved.tree), allow_nan=False))
    again = loader.resolve_deployment(handed_over, {}, "resolved.json")
    assert (again.deployment, again.digest) == (resolved.deployment, resolved.digest)
    if path.name != "base.toml":
        assert check_deployment(resolved).robot.name == resolved.deployment.robot


# --- a plan: the parts fit each other ----------------------------------------------------------------------


@pytest.fixture
def demo():
    return DEPLOYMENTS / "demo.toml"


def planned(path, *assignments):
    return check_deployment(load(path, assignments))


def test_report_only_is_refused_where_a_robot_can_move(demo):
    with pytest.raises(SetupError, match=r"safety.report_only = true with transport 'zmq': it can move"):
        planned(demo, "safety.report_only=true")


def test_report_only_is_for_a_recording():
    given = ("transport.path=x", "policy.path=x")
    assert planned(DEPLOYMENTS / "replay_dataset.toml", *given).deployment.safety.report_only


def test_a_robot_that_does_not_exist_is_refused(demo):
    with pytest.raises(ConfigurationError, match="no_such_robot"):
        planned(demo, "robot=no_such_robot")


def test_a_pose_that_the_robot_does_not_have_is_refused_with_those_it_has(demo):
    with pytest.raises(ConfigurationError, match=r"setup.pose = 'moon': \w+ has .*home"):
        planned(demo, "setup.pose=moon")


def test_a_box_for_an_arm_that_the_robot_does_not_have_is_refused_with_those_it_has(demo):
    box = ("safety.workspace.third.lower=[0,0,0]", "safety.workspace.third.upper=[1,1,1]")
    with pytest.raises(ConfigurationError, match=r"safety.workspace.third: \w+ has the arms \w+"):
        planned(demo, *box)


def test_more_rows_than_ticks_are_refused(demo):
    with pytest.raises(ConfigurationError, match=r"recording.fps = 60: .*; allowed: at most 25, the"):
        planned(demo, "control.rate=25", "recording.fps=60")
    assert planned(demo, "control.rate=25", "recording.fps=25").fps == 25


def test_without_a_rate_the_robots_own_counts(demo):
    made = planned(demo)
    assert made.rate == made.fps == made.robot.control_rate
    assert planned(demo, "control.rate=50").fps == 50


def test_changes_go_on_top_like_a_file_over_what_it_extends(write):
    own = load(write())
    changed = loader.apply_changes(own, {"task": "fold", "policy": {"amplitude": 0.1}}, "setup")
    assert (changed.deployment.task, changed.deployment.policy.amplitude) == ("fold", 0.1)
    assert changed.deployment.transport == own.deployment.transport
    assert changed.digest != own.digest
    assert loader.apply_changes(own, {}, "setup") == own
    assert own == load(write())


def test_a_change_of_kind_replaces_the_table_whole(write):
    own = load(write(SMALL + "amplitude = 0.1\n"))
    changed = loader.apply_changes(own, {"policy": {"kind": "openpi", "url": "ws://a:1"}}, "setup")
    assert (changed.deployment.policy.kind, changed.deployment.policy.url) == ("openpi", "ws://a:1")


def test_a_wrong_change_names_where_it_came_from(write):
    own = load(write())
    with pytest.raises(ConfigurationError, match=r"^setup: policy\.amplitud = 1: unknown key"):
        loader.apply_changes(own, {"policy": {"amplitud": 1}}, "setup")
    with pytest.raises(
        ConfigurationError, match=r"^setup: policy\.kind = \[\]: must be one of 'external', 'gr00t'"
    ):
        loader.apply_changes(own, {"policy": {"kind": []}}, "setup")


def test_a_policy_may_be_left_out_where_there_is_a_collection_and_nowhere_else(small):
    path = small
    text = path.read_text("utf-8")
    path.write_text(re.sub(r"\[policy\][^\[]*", "", text), "utf-8")
    assert "policy is missing and has no default; it may be left out with a [collection]" in refusal(path)
    assert load(path, ["collection.source=node"]).deployment.policy.kind == "none"


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"source": "relay"}, "collection.leader is missing"),
        ({"source": "node", "leader": {"kind": "zmq"}}, "the node reads its own"),
        ({"source": "node", "mode": "relative"}, "the node decides that"),
        ({"source": "node", "streams": ["effort"], "columns": ["eef"]}, "leaves out effort"),
        (
            {"source": "relay", "leader": {"kind": "zmq", "endpoint": "tcp://10.0.0.7:5560"}},
            "leaves this machine over a plain link",
        ),
    ],
)
def test_a_collection_that_contradicts_itself_is_refused(given, why):
    with pytest.raises(ConfigurationError, match=why):
        CollectionSettings.model_validate(given)
