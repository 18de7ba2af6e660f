"""The whole channel: scripts with sockets of their own against a station in lockstep."""

import json
import re
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.clients.channel.holder_names import HolderNames
from runtime.clients.client import Refused, StationClient
from runtime.ipc.session_state import SessionState
from tests import presses
from tests.examples import some
from tests.processes import PATIENCE_MS, eventually
from tests.runtime.clients.channel.bench import Bench
from tests.runtime.lockstep_station import STANDS
from tests.sources import ROOT

HERE = "tcp://127.0.0.1:5757"
FAR = [STANDS[0] + 0.05, *STANDS[1:]]


@pytest.fixture
def start(tmp_path):
    made = []

    def start(state=SessionState.IDLE, **options):
        bench = Bench(tmp_path, **options)
        made.append(bench)
        bench.reach(SessionState.IDLE)
        if state is not SessionState.IDLE:
            script = bench.script(client="first")
            assert script.result(script.cmd("setup"))["result"] == "done"
            script.command("give_up")
        return bench

    yield start
    for bench in made:
        bench.close()


def done(answer):
    assert (answer["ok"], answer["result"]) == (True, "done"), answer
    return answer


def accepted(answer):
    assert (answer["ok"], answer["result"]) == (True, "accepted"), answer
    return answer


def refused(answer):
    assert (answer["ok"], answer["result"]) == (False, "refused"), answer
    return answer["error"]


# --- what existing scripts say, word by word -----------------------------------------------------------------


def test_a_session_of_an_existing_script_from_task_to_saved_rollout(start):
    script = start().script()
    answer = script.cmd("select_task", task="fold the cloth")
    assert (answer["ok"], answer["cmd"]) == (True, "web:select_task")
    answer = script.cmd("select_collect_task", task="wipe")
    assert answer == {"ok": True, "selected_collect_task": "wipe"}
    assert script.cmd("select_collect_task:rinse") == {"ok": True, "selected_collect_task": "rinse"}
    answer = script.cmd("tab_switch:collect", armed=True)
    assert (answer["ok"], answer["tab"], answer["armed"]) == (True, "collect", True)
    setup = accepted(script.cmd("setup"))
    assert setup["cmd"] == "web:setup"
    assert script.result(setup)["result"] == "done"
    assert script.query("status")["is_setup_done"] is True
    assert script.query("status")["selected_task"] == "fold the cloth"
    run = accepted(script.cmd("start"))
    eventually(lambda: script.query("status")["chunk_index"] > 1, "chunks")
    done(script.cmd("halt"))
    assert script.query("status")["session_status"] == "holding"
    assert script.result(run)["result"] == "failed"  # it did not go on to its end
    again = accepted(script.cmd("run"))
    assert done(script.cmd("stop"))["state"] == "ready"
    assert script.result(again)["result"] == "done"
    saved = eventually(lambda: script.cmd("rollout_save")["ok"] and script.cmd("rollout_save"), "an episode")
    assert saved["data"]["episode"]["uuid"] == run["data"]["episode"]


def test_queries_have_the_older_form(start):
    bench = start()
    script = bench.script()
    assert script.send(query="status").keys() == {"ok", "data"}
    frame = script.query("frame")
    assert frame["cameras"] == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
    assert frame["qpos"] == pytest.approx(STANDS, abs=1e-6)
    config = script.query("config")
    assert (config["robot_type"], config["transport_type"]) == ("agilex_piper", "dataset")
    assert len(config["joint_names"]) == 14
    assert script.query("station")["boot"] == bench.station.coordinator.boot
    first, *_ = script.query("events", since=0)
    assert first["number"] == 1
    assert "web:setup" in script.query("commands")["cmd"]


def test_the_script_of_the_document_sets_up_and_runs(start):
    bench = start()
    document = (ROOT / "docs/control-channel.md").read_text("utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", document, re.DOTALL)
    assert HERE in script
    names = {}
    try:
        exec(script.replace(HERE, bench.channel).replace("duration_s=20", "duration_s=2"), names)
    finally:
        names["socket"].close()
    assert bench.station.reason == "the run's 2 s are over"
    assert bench.station.coordinator.lease.current(bench.station.clock.now()) is None


# --- results -------------------------------------------------------------------------------------------------


def test_arguments_are_checked_before_the_answer_and_nothing_is_changed(start):
    bench = start(SessionState.READY)
    script = bench.script()
    assert "duration_s" in refused(script.command("run", duration_s=-1))
    assert "timeout" in refused(script.command("run", timeout=1))  # a word of the client's own
    aim = {"command": "aim", "arguments": {"kind": 1, "timeout": 2}}
    eventually(lambda: "kind" in script.send(**aim)["error"], "what is wrong with it, once it can be solved")
    assert "colour" in refused(script.command("setup", colour="red"))
    assert "k_max" in refused(script.cmd('update_infer_params:{"k_max": "many"}'))
    assert "needs 14 finite numbers" in refused(script.cmd('init_move:{"qpos": [0]}'))
    assert bench.station.state is SessionState.READY


def test_what_the_station_refuses_is_told_with_what_is_allowed(start):
    script = start().script()
    answer = script.cmd("start")
    assert "run is not allowed while idle" in refused(answer)
    assert "allowed: setup" in answer["error"]
    assert script.query("result", id=answer["id"])["result"] == "refused"
    assert script.query("status")["last_error"] == answer["error"]


def test_a_failed_set_up_is_told_as_the_result_with_its_reason(start):
    script = start(absent="no policy server listens at ws://localhost:1").script()
    found = script.result(accepted(script.cmd("setup")))
    assert found["result"] == "failed"
    assert "no policy server listens" in found["reason"]


def test_the_same_id_is_done_once_and_another_commands_id_is_refused(start):
    bench = start(SessionState.READY)
    script = bench.script()
    identity = "0b1c7f1e-57a1-4f0e-9b43-0a8a0d2f8a11"
    run = accepted(script.send(command="run", id=identity))
    assert run["id"] == identity
    done(script.cmd("halt"))
    assert script.result(run)["result"] == "failed"
    assert script.send(command="run", id=identity)["result"] == "failed"
    assert "was given to 'run' before" in refused(script.send(command="resume", id=identity))
    assert bench.station.state is SessionState.HOLDING
    done(script.send(command="stop", id=identity))  # a stop is obeyed all the same


def test_chunk_by_chunk_and_by_hand(start):
    bench = start(SessionState.READY)
    script = bench.script()
    done(script.cmd("select_mode:step"))
    accepted(script.cmd("start"))
    step = eventually(lambda: (one := script.cmd("step_infer"))["ok"] and one, "a step")
    assert script.result(step)["result"] == "done"
    assert script.query("status")["pending_chunk"]["rows"] > 0
    assert script.result(accepted(script.cmd("step_commit")))["result"] == "done"
    done(script.cmd("stop"))
    done(script.cmd("select_mode:manual"))
    accepted(script.cmd("start"))
    done(script.cmd("manual_qpos:" + ",".join(map(str, FAR))))
    move = eventually(lambda: (one := script.cmd("manual_send"))["ok"] and one, "a move")
    assert script.result(move)["result"] == "done"
    assert script.query("frame")["qpos"][0] == pytest.approx(FAR[0], abs=1e-3)
    half = script.result(accepted(script.cmd("gripper:left:0.03")))
    assert half["result"] == "done"
    assert script.query("frame")["qpos"][6] == pytest.approx(0.03, abs=1e-3)
    assert "left_arm" in refused(script.cmd("gripper:left:7"))
    aim = script.command("aim", joints=FAR)
    assert (aim["ok"], aim["data"]["reached"]) == (True, True)


def test_a_recording_without_a_run_has_the_task_that_was_selected_for_it(start):
    bench = start()
    script = bench.script()
    script.cmd("select_collect_task", task="wipe the table")
    begun = done(script.cmd("collect_start"))
    eventually(lambda: script.query("status")["collect"], "a recording")
    done(script.cmd("collect_stop"))
    path = eventually(lambda: script.query("station")["episode"].get("path"), "an episode")
    assert bench.station.episode().manifest["task"] == "wipe the table"
    assert begun["data"]["episode"] in path


# --- who may command -----------------------------------------------------------------------------------------


def test_a_script_takes_a_lease_of_its_own_and_the_next_is_refused_with_a_sentence(start):
    bench = start(scripts="apart")
    one, two = bench.script(), bench.script(client="two")
    done(one.command("claim"))
    why = refused(two.cmd("setup"))
    assert "channel:lab#" in why
    assert "holds the lease" in why
    assert "client" in why
    done(one.command("give_up"))
    done(two.command("claim"))
    assert two.query("status")["lease"]["holder"] == "channel:lab/two"


def test_while_a_terminal_holds_the_lease_a_script_is_refused(start):
    bench = start()
    terminal = StationClient(bench.folder, "terminal:anna")
    terminal.claim()
    assert "terminal:anna holds the lease" in refused(bench.script().cmd("setup"))
    assert 'anybody may {"command": "estop"}' in refused(bench.script().cmd("halt"))
    terminal.close()


def test_a_terminal_is_refused_while_a_script_holds_it(start):
    bench = start()
    done(bench.script(client="night").command("claim"))
    terminal = StationClient(bench.folder, "terminal:anna")
    with pytest.raises(Refused, match="channel:lab/night holds the lease"):
        terminal.claim()
    terminal.close()


def test_a_script_that_dies_loses_its_lease_and_the_robot_holds(start):
    bench = start(SessionState.READY)
    script = bench.script()
    accepted(script.cmd("start"))
    script.close()
    bench.now += bench.silence_s + 1
    bench.reach(SessionState.HOLDING)
    assert "lease" in bench.station.reason
    other = bench.script()
    done(other.cmd("stop"))


@pytest.mark.some(1)
@pytest.mark.parametrize("scripts", ["together", "apart"])
def test_a_dashboard_does_not_keep_a_dead_scripts_lease(start, scripts):
    bench = start(SessionState.READY, scripts=scripts)
    dashboard = bench.script()
    assert dashboard.query("status")["state"] == "ready"
    accepted(bench.script().cmd("start"))

    def looked():
        bench.now += bench.silence_s / 4
        for question in ("frame", "config", "station", "events"):  # also with a connection for each
            bench.script().query(question)
        return dashboard.query("status")["state"] == "holding"

    eventually(looked, "holding")


def test_a_dashboards_stop_button_does_not_make_it_a_script(start):
    bench = start(SessionState.READY)
    dashboard = bench.script()
    accepted(bench.script().cmd("start"))
    done(dashboard.cmd("stop"))
    accepted(bench.script().cmd("start"))

    def looked():
        bench.now += bench.silence_s / 4
        return dashboard.query("status")["state"] == "holding"

    eventually(looked, "holding")


@pytest.mark.some(1)
@pytest.mark.parametrize("question", ["status", "result"])
def test_a_script_waits_with_a_connection_for_every_question(start, question):
    bench = start(SessionState.READY)
    run = accepted(bench.script().cmd("start"))
    for _ in range(5):
        bench.now += bench.silence_s / 2
        bench.script().query(question, id=run["id"])
        bench.kept()
        assert bench.station.state is SessionState.RUNNING


@pytest.mark.exhaustive
def test_a_script_that_asks_now_and_then_keeps_it(start):
    bench = start(SessionState.READY)
    script = bench.script()
    accepted(script.cmd("start"))
    for _ in range(5):
        bench.now += bench.silence_s / 2
        assert script.query("status")["state"] == "running"
        bench.kept()


def test_scripts_without_a_name_are_one_even_with_a_connection_for_every_message(start):
    bench = start()
    setup = accepted(bench.script().cmd("setup"))
    assert bench.script().result(setup)["result"] == "done"
    accepted(bench.script().cmd("start"))
    done(bench.script().cmd("stop"))
    assert "channel:lab holds the lease" in refused(bench.script(client="other").cmd("start"))


def test_two_scripts_at_once_get_answers_of_their_own(start):
    bench = start()
    scripts = [bench.script(client=f"s{number}") for number in range(4)]

    def talk(script):
        return [
            (script.query("status")["state"], script.cmd(f"select_collect_task:{script.common['client']}"))
            for _ in range(20)
        ]

    with ThreadPoolExecutor(len(scripts)) as pool:
        talks = list(pool.map(talk, scripts))
    for number, told in enumerate(talks):
        assert told == [("idle", {"ok": True, "selected_collect_task": f"s{number}"})] * 20


# --- resets --------------------------------------------------------------------------------------------------


@pytest.mark.some(1)
@pytest.mark.parametrize("verb", ["reset", "console_reset", "operator_action:rollout_reset:node"])
def test_a_reset_ends_a_halted_run_and_goes_home(start, verb):
    script = start(SessionState.READY).script()
    done(script.cmd("select_mode:manual"))
    accepted(script.cmd("start"))
    done(script.cmd("manual_qpos:" + ",".join(map(str, FAR))))
    move = eventually(lambda: (one := script.cmd("manual_send"))["ok"] and one, "a move")
    assert script.result(move)["result"] == "done"
    assert "home is not allowed while running" in refused(script.cmd(verb))
    done(script.cmd("halt"))
    assert script.result(accepted(script.cmd(verb)))["result"] == "done"
    assert script.query("frame")["qpos"][0] == pytest.approx(STANDS[0], abs=1e-3)


def test_a_reset_that_cannot_go_home_is_refused(start):
    assert "home is not allowed while idle" in refused(start().script().cmd("console_reset"))


# --- stops ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", ["halt", "stop", "operator_action:cancel:node"])
def test_any_script_of_the_channel_stops_what_another_has_begun(start, verb):
    bench = start(SessionState.READY)
    accepted(bench.script(client="one").cmd("start"))
    answer = done(bench.script().cmd(verb))
    assert answer["state"] == ("holding" if verb == "halt" else "ready")


def test_a_stop_is_not_refused_for_its_arguments(start):
    bench = start(SessionState.READY)
    script = bench.script()
    accepted(script.cmd("start"))
    done(script.command("halt", whatever=[1]))


def test_the_estop_needs_no_lease_and_no_main(start):
    bench = start(SessionState.READY)
    runner = bench.script()
    accepted(runner.cmd("start"))
    bench.frozen = True  # the coordinator answers nothing any more
    waiting, presser = bench.script(), bench.script()
    waiting.socket.send(b'{"cmd": "web:reset"}')
    answer = done(presser.command("estop", why="smoke"))
    assert "measured position" in answer["reason"]
    bench.frozen = False
    bench.reach(SessionState.FAULTED)
    assert "smoke" in bench.station.reason
    assert waiting.socket.poll(PATIENCE_MS)
    assert json.loads(waiting.socket.recv())["ok"] is False
    done(runner.command("release"))
    bench.reach(SessionState.IDLE)


@pytest.mark.parametrize(("key", "name"), [("command", "estop"), ("cmd", "web:estop"), ("cmd", "estop")])
def test_whatever_is_wrong_with_a_press_it_is_pressed(start, key, name):
    bench = start()
    for what, text in presses.in_json(key, name).items():
        answer = bench.script().raw(text.encode())
        assert (what, answer["ok"], answer["result"]) == (what, True, "done")
    done(bench.script().raw(b"", json.dumps({key: name}).encode()))  # two frames


def test_the_reason_of_a_press_is_kept_as_long_as_a_latch_has_room(start):
    bench = start()
    done(bench.script().cmd("estop:smoke"))
    assert bench.station.guard._latched == ("channel:lab", "smoke")
    done(bench.script().command("estop", why="y" * 60_000))
    assert bench.station.guard._latched == ("channel:lab", "y" * 240)


def test_a_station_that_does_not_answer_is_told_and_asked_again(start):
    bench = start()
    script = bench.script()
    bench.frozen = True
    answer = script.cmd("setup")
    assert "console context not ready: no answer" in refused(answer)
    assert "console context not ready" in script.send(query="status")["error"]
    stopped = script.cmd("halt")
    assert (stopped["ok"], stopped["result"]) == (False, "unknown")
    assert "estop" in stopped["error"]
    bench.frozen = False
    eventually(lambda: script.cmd("setup")["ok"], "an answer")


# --- noise ---------------------------------------------------------------------------------------------------


@settings(max_examples=some(60), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(frames=st.lists(st.binary(max_size=40), min_size=1, max_size=3))
def test_noise_is_answered_and_changes_nothing(noisy, frames):
    answer = noisy.raw(*frames)
    assert answer["ok"] is False
    assert answer["error"]


VERB = st.sampled_from(
    ["start", "gripper", "init_move", "manual_qpos", "select_mode", "tab_switch", "update_infer_params"]
)


@settings(max_examples=some(80), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    verb=VERB, argument=st.text(max_size=20) | st.from_regex(r"[lr]:(open|close)?:?[0-9e.]*", fullmatch=True)
)
def test_any_argument_of_a_verb_is_answered(noisy, verb, argument):
    answer = noisy.cmd(f"{verb}:{argument}")
    assert isinstance(answer["ok"], bool)
    assert answer["ok"] or not answer["error"].startswith("handler error")


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    bench = Bench(tmp_path_factory.mktemp("noisy"))
    bench.reach(SessionState.IDLE)
    script = bench.script()
    yield script
    assert script.query("status")["state"] == "idle"
    bench.close()


def test_the_names_of_holders_cannot_be_those_of_others():
    names = HolderNames("lab", "apart")
    assert names.holder(b"a", "") == "channel:lab#1"
    assert names.holder(b"b", "") == "channel:lab#2"
    assert names.holder(b"a", "") == "channel:lab#1"
    assert names.holder(b"a", "night") == names.holder(b"b", "night") == "channel:lab/night"
    assert HolderNames("lab", "together").holder(b"a", "") == "channel:lab"
