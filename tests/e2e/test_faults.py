"""What goes wrong in a lab, with real processes: each time nothing is lost, and a sentence says what to do."""

import json
import os
import signal
import socket
import threading
from base64 import b64encode
from contextlib import closing, contextmanager, suppress
from urllib.parse import urlsplit
from uuid import UUID

import pytest

from evaweb.lab.stall_detection import DemoFailed
from runtime.clients.client import StationClient
from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import DEAD, STATION, WIDE
from tests.e2e.remote import SKILLED, opened, page_of, refusal, reset_station, visitor, was_late
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo(shared):
    return shared


@pytest.fixture(scope="module")
def people(demo):
    """Everybody, logged in."""
    return {name: visitor(demo, name) for name in ("operator", "ann", "visitor", "admin")}


@pytest.fixture
def station(people):
    """Left in order whatever becomes of it."""
    yield
    reset_station(people["admin"])


@pytest.fixture
def bench(people, station):
    """The operator's page, who has the station."""
    with page_of(people["operator"]) as page:
        page.wait(lambda state: state["state"] != "disconnected", PATIENCE_S, "the station")
        page.take()
        yield page


def test_two_people_press_run_and_the_one_who_has_the_station_runs(bench, people):
    trial = bench.prepare()
    bench.set_up(trial)
    with page_of(people["ann"]) as other:
        assert "operator holds the lease" in refusal(lambda: other.press("run", trial=trial))
        assert "operator has" in refusal(other.claim)
    answers = []

    def press():
        try:
            answers.append(bench.press("run", trial=trial)["status"])
        except Exception as refused:
            answers.append(str(refused))

    presses = [threading.Thread(target=press) for _ in range(2)]
    for each in presses:
        each.start()
    for each in presses:
        each.join()
    assert answers.count("accepted") == 1, answers
    assert any("HTTP 409" in answer for answer in answers), answers
    bench.goes_on(trial)
    bench.stop(trial)


def test_a_command_decided_by_an_old_state_is_refused(bench):
    old = bench.state()
    trial = bench.prepare()
    bench.set_up(trial)
    sentence = refusal(lambda: bench.press("run", trial=trial, sequence=old["sequence"]))
    assert "stale" in sentence
    assert "the state has changed" in sentence
    assert "stale" in refusal(lambda: bench.press("run", trial=trial, boot="another"))
    assert bench.status(trial) == "prepared"


def test_a_worker_that_is_killed_right_after_a_score_publishes_the_episode_once(demo, bench):
    trial = bench.running()
    bench.stop(trial)
    bench.score(trial)
    episode = bench.trial(trial)["episode"]
    jobs = "SELECT status FROM jobs_job WHERE key = ? AND status IN ('running', 'done')"
    eventually(lambda: demo.rows(jobs, f"publish:{episode}"), "the dataset is being written", 3 * PATIENCE_S)
    os.kill(demo.pid("worker"), signal.SIGKILL)
    placed = eventually(lambda: placed_at(bench, episode), "the episode is in the dataset", 3 * PATIENCE_S)
    waiting = "SELECT key FROM jobs_job WHERE status IN ('queued', 'running')"
    eventually(lambda: not demo.rows(waiting), "the worker has nothing left to do", 3 * PATIENCE_S)
    meta = demo.data / placed["dataset"] / "meta"
    lines = [json.loads(line) for line in (meta / "eva_episodes.jsonl").read_text().splitlines()]
    assert [line["episode_index"] for line in lines if line["uuid"] == episode] == [placed["dataset_index"]]
    assert json.loads((meta / "info.json").read_text())["total_episodes"] == len(lines)


def test_a_page_that_is_closed_mid_run_leaves_a_robot_that_holds_for_the_next_operator(bench, people):
    trial = bench.running()
    bench.close()
    with page_of(people["ann"]) as other:
        assert "lease" in other.holds(trial)
        other.take()
        other.resume(trial)
        other.stop(trial)
        facts = other.trial(trial)
    assert facts["operator"] == "operator"
    assert facts["reason"] == "stop by ann"
    assert facts["duration_s"] < 40


def test_a_web_that_is_killed_mid_run_comes_back_and_the_page_goes_on(demo, bench):
    trial = bench.running()
    os.kill(demo.pid("serve"), signal.SIGKILL)
    with closing(bench.again()) as page:
        kept = page.renewed()
        if not kept:  # the web was away for longer than the lease lives
            page = opened(bench.visitor, bench.page)
            page.holds(trial)
            page.take()
            page.resume(trial)
        page.goes_on(trial)
        page.stop(trial)
        whole(page, trial)


def test_a_web_that_stays_away_leaves_a_robot_that_holds_until_the_operator_resumes(demo, bench):
    trial = bench.running()
    station = StationClient(demo.data / "stations" / STATION)
    with closing(station), suspended(demo.child.pid):  # who would start the web again
        os.kill(demo.pid("serve"), signal.SIGKILL)
        held = station.wait(lambda s: s["state"] == "holding" and not s["lease"]["holder"], PATIENCE_S)
        assert "lease" in held["reason"] or was_late(held["reason"])
    with closing(opened(bench.visitor, bench.page)) as page:
        assert page.holds(trial) == held["reason"]
        page.take()
        page.resume(trial)
        page.stop(trial)
        whole(page, trial)


def test_a_browser_that_stops_reading_costs_the_others_nothing(demo, bench, people):
    with deaf(people["visitor"]) as silent, deaf(people["ann"]):
        bench.draws(30)
        silent.shutdown(socket.SHUT_RD)
        bench.draws(10)
        assert bench.state()["lease"]["epoch"] == bench.epoch
    bench.draws(10)


@pytest.mark.story
def test_while_the_database_is_locked_pictures_go_on_and_the_e_stop_works(demo, bench):
    trial = bench.running()
    with demo.locked():
        bench.draws(20)
        renewals = len(bench.renewals())
        eventually(lambda: len(bench.renewals()) > renewals + 1, "the lease is renewed")
        assert bench.renewals()[-1]["ok"]
        answer = bench.estop()
        assert answer["status"] == "done", answer
        bench.wait(lambda state: state["state"] == "faulted", PATIENCE_S, "the e-stop")
        assert bench.status(trial) == "running"  # nobody could write it down
    eventually(lambda: bench.status(trial) == "interrupted", "the trial is known as interrupted")
    row = "SELECT status FROM stations_command WHERE uuid = ?"
    pressed = UUID(answer["uuid"]).hex
    eventually(lambda: demo.rows(row, pressed) == [("done",)], "the e-stop is written down")
    bench.command("release")
    bench.wait(lambda state: state["state"] == "idle", PATIENCE_S, "released")


def test_an_unknown_checkpoint_is_refused_with_what_there_is(bench):
    sentence = refusal(lambda: bench.prepare(checkpoint="pick-place-1M"))
    assert "HTTP 404" in sentence
    assert "'pick-place-1M' does not exist; there are:" in sentence
    assert SKILLED in sentence


def test_a_policy_that_nobody_serves_ends_the_set_up_with_its_address(bench):
    trial = bench.prepare(checkpoint=DEAD)
    bench.command("setup", trial)
    state = bench.wait(lambda state: state["state"] != "setting_up", PATIENCE_S, "the end of the set-up")
    assert state["state"] == "idle"
    assert "ws://127.0.0.1:1" in state["reason"]
    assert bench.status(trial) == "prepared"
    assert "run is not allowed while idle" in refusal(lambda: bench.command("run", trial))


def test_a_policy_server_that_dies_mid_run_is_tried_again_until_it_is_back_or_patience_ends(demo, bench):
    trial = bench.running()
    os.kill(demo.pid(SKILLED), signal.SIGKILL)
    lost = bench.wait(
        lambda s: s["policy"]["lost"] or s["state"] == "holding", PATIENCE_S, "the policy is lost"
    )
    answers = lost["policy"]["answers"]

    def goes_on():
        if bench.state()["state"] == "holding":
            with suppress(DemoFailed):  # refused for as long as a process is late to give a sign of life
                bench.command("resume", trial)
        return bench.state()["state"] == "running" and bench.state()["policy"]["answers"] > answers

    eventually(goes_on, "the policy answers again", 3 * PATIENCE_S)
    bench.goes_on(trial)
    bench.stop(trial)
    whole(bench, trial)


@pytest.mark.story
def test_a_viewer_stops_the_robot_and_only_the_operator_releases_it(bench, people):
    with page_of(people["visitor"]) as watching:
        assert watching.estop("a hand in the way")["status"] == "done"
        bench.wait(lambda state: state["state"] == "faulted", PATIENCE_S, "the e-stop")
        assert "HTTP 403" in refusal(lambda: watching.press("release"))
    assert "a hand in the way" in bench.state()["estop"]
    bench.command("release")
    bench.wait(lambda state: state["state"] == "idle", PATIENCE_S, "released")


@pytest.fixture(scope="module")
def window(browser, demo, people):
    """The second operator's browser."""
    window = BenchPage(browser, demo, "ann", WIDE)
    yield window
    window.close()


@pytest.fixture
def commanding(window, station):
    """Its Eval page, which has the station."""
    window.open(f"/stations/{STATION}/eval/")
    window.at_rest()
    window.take()
    return window


def test_the_page_says_which_policy_does_not_answer_and_lets_one_choose_again(commanding):
    page = commanding.page
    page.select_option("#checkpoint-choice", DEAD)
    page.check("input[name=position][value='1']")
    page.click("[data-prepare]")
    step = page.locator("[data-step=setup]")
    eventually(
        lambda: "ws://127.0.0.1:1: start it" in step.inner_text(), "the step says what to do", 3 * PATIENCE_S
    )
    assert commanding.state() == "IDLE"
    page.click("[data-abandon]")
    page.locator("#checkpoint-choice").wait_for()


def test_a_page_outlives_the_web_and_says_meanwhile_that_nothing_is_known(demo, commanding):
    page = commanding.page
    with suspended(demo.child.pid):
        os.kill(demo.pid("serve"), signal.SIGKILL)
        commanding.reaches("NO CONNECTION")
        page.locator("#situation", has_text="nothing is known").wait_for()
        page.locator("[data-prepare][aria-disabled=true]").wait_for()
    commanding.at_rest()
    commanding.cameras_live()
    commanding.take_again()
    page.locator("[data-prepare][aria-disabled=false]").wait_for()


@contextmanager
def suspended(pid):
    """The process stands still."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@contextmanager
def deaf(visitor):
    """A browser that has opened the live page with everything on it and reads nothing of it."""
    address = urlsplit(visitor.url)
    with socket.create_connection((address.hostname, address.port), PATIENCE_S) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        lines = (
            f"GET /ws/stations/{STATION}?page={os.urandom(8).hex()} HTTP/1.1",
            f"Host: {address.netloc}",
            f"Origin: {visitor.url}",
            f"Cookie: {visitor.cookies}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Key: {b64encode(os.urandom(16)).decode()}",
        )
        connection.sendall("\r\n".join((*lines, "", "")).encode())
        assert connection.recv(12) == b"HTTP/1.1 101"
        cameras = ("cam_high", "cam_left_wrist", "cam_right_wrist")
        streams = ["state", "joints", "poses", *(f"camera/{camera}" for camera in cameras)]
        wanted = json.dumps({"type": "watch", "streams": streams}).encode()
        assert 126 <= len(wanted) < 65536
        connection.sendall(b"\x81\xfe" + len(wanted).to_bytes(2, "big") + bytes(4) + wanted)  # masked with 0
        yield connection


def whole(page, trial):
    """The record of an ended trial comes to agree with its recording."""

    def agree():
        facts = page.trial(trial)
        episode = page.visitor.get(f"episodes/{facts['episode']}")
        recorded = episode["status"] == "finished" and facts["duration_s"] == episode["duration_s"]
        return recorded and facts["truth"] is not None

    eventually(agree, f"trial {trial} is as long as its recording, and the bench has said how it was left")


def placed_at(page, episode):
    facts = page.visitor.get(f"episodes/{episode}")
    return facts if facts["dataset_index"] is not None else None
