import pytest

from runtime.clients.terminal import syntax
from runtime.clients.terminal.syntax import parse
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.transitions import COMMANDS


def said(*words):
    return parse(["bench-1", *words])


@pytest.mark.parametrize(
    "command",
    [
        *(
            "setup",
            "run",
            "step",
            "commit",
            "cancel",
            "approach",
            "home",
            "stop",
            "halt",
            "resume",
            "release",
        ),
        *("estop", "status", "watch", "events"),
    ],
)
def test_a_command_needs_no_more_than_its_word(command):
    given = said(command)
    assert (given.station, given.command, given.json) == ("bench-1", command, False)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("bench-1 estop now please", "now please"),
        ("bench-1 estop --why smoke", "smoke"),
        ("bench-1 estop --speed 3", "3"),
        ("bench-1 --loud estop", "pressed in a terminal"),
        ("estop bench-1", "pressed in a terminal"),
        ("--colour bench-1 estop", "pressed in a terminal"),
        ("bench-1 estop --data-dir", "pressed in a terminal"),
    ],
)
def test_a_press_is_one_whatever_else_is_said(words, why):
    given = parse(words.split())
    assert (given.station, given.command, given.why) == ("bench-1", "estop", why)


def test_a_press_with_a_word_too_many_goes_where_it_was_said():
    given = parse(["--data-dir=/a", "bench-1", "estop", "--json", "--loud"])
    assert (given.data_dir, given.json) == ("/a", True)


@pytest.mark.parametrize(
    "words", ["bench-1 label bad --note estop", "bench-1 halt estop", "estop", "bench-1 estop -h"]
)
def test_what_only_has_the_word_in_it_is_no_press(words):
    with pytest.raises(SystemExit):
        parse(words.split())


def test_every_command_of_the_session_can_be_said():
    words = {"record" if kind.startswith("record_") else kind for kind in COMMANDS}
    assert words <= set(syntax._COMMANDS)


def test_every_state_can_be_waited_for():
    assert set(SessionState) <= set(syntax.WORDS)


def test_the_data_folder_can_be_said_before_and_after_the_command(monkeypatch):
    monkeypatch.setenv("EVA_DATA_DIR", "/var/eva")
    assert said("status").data_dir == "/var/eva"
    assert said("status", "--data-dir", "/a").data_dir == "/a"
    assert parse(["--data-dir", "/a", "bench-1", "status"]).data_dir == "/a"


def test_numbers_may_begin_with_a_minus():
    assert said("move", "--joints", "-0.1,0.2,-1e-3").joints == [-0.1, 0.2, -1e-3]
    jog = said("jog", "left", "--xyz", "-10,0,5", "--rpy=-1,0,0", "--frame", "tool")
    assert (jog.arm, jog.xyz, jog.rpy, jog.frame) == ("left", [-10, 0, 5], [-1, 0, 0], "tool")


def test_joints_are_set_or_changed_by_name():
    given = said("move", "--joint", "a=0.5", "b+=0.1", "--joint", "c-=0.2")
    assert given.joint == [("a", "=", 0.5), ("b", "+", 0.1), ("c", "-", 0.2)]


def test_settings_are_json_where_they_are_some_else_words():
    given = said("tune", "--set", "k_max=3", "blend_window=all", "--set", "inference_rate=none", "x=NaN")
    assert dict(given.set) == {"k_max": 3, "blend_window": "all", "inference_rate": None, "x": "NaN"}
    assert dict(said("setup", "--policy", "kind=openpi", 'url="ws://a:1"').policy) == {
        "kind": "openpi",
        "url": "ws://a:1",
    }


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["dance"], "invalid choice: 'dance'"),
        (
            ["run", "--colour", "blue"],
            "run does not take --colour blue; it takes --arm, --data-dir, --duration, ",
        ),
        (
            ["stop", "--policy-url", "ws://a:1"],
            "stop does not take --policy-url ws://a:1; it takes --data-dir",
        ),
        (["run", "--mode", "dance"], "choose from"),
        (["run", "--duration", "nan"], "nan was given; allowed: finite numbers"),
        (["record"], "required: what"),
        (["move"], "one of the arguments --pose --joints --joint is required"),
        (["move", "--pose", "home", "--joints", "1,2"], "not allowed with"),
        (["move", "--joint", "a"], "a was given; allowed: NAME=VALUE, NAME+=VALUE, NAME-=VALUE"),
        (["move", "--joint", "+=1"], "+=1 was given; allowed: NAME=VALUE"),
        (["move", "--joints", "1,x"], "invalid"),
        (["jog", "left"], "jog needs --xyz, --rpy or both"),
        (["jog", "left", "--xyz", "1,2"], "1,2 has 2 numbers; allowed: three, as 10,0,-5"),
        (["aim"], "one of the arguments --pose --joints --joint --arm is required"),
        (["tune"], "tune needs --strategy, --set, --task or --show"),
        (["tune", "--set", "k_max"], "k_max was given; allowed: KEY=VALUE"),
        (["setup", "--cancel", "--task", "fold"], "setup --cancel takes nothing else"),
        (["gripper", "squeeze"], "choose from"),
        (["wait", "godot"], "choose from"),
    ],
)
def test_what_cannot_be_said_is_answered_with_what_can(capsys, words, says):
    with pytest.raises(SystemExit) as ended:
        said(*words)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
