"""A whole session from a terminal: real processes, every mode, exit codes."""

import contextlib
import fcntl
import io
import json
import os
import pty
import select
import signal
import subprocess
import sys
import termios

import numpy as np
import pytest

from runtime import ctl as ctl_module
from runtime.simulation import drives
from tests.crash.lab import ROOT, Lab
from tests.processes import eventually

# What a run of the mode does once it has begun.
IDLE_PHASE = {"step": "waiting", "preview": "waiting", "manual": "waiting", "sim": "executing"}


class Terminal:
    """Command lines to the station of a lab."""

    def __init__(self, lab):
        self._lab = lab
        self._words = [sys.executable, "-m", "runtime.ctl", "--data-dir", str(lab.data), "demo"]

    def __call__(self, *words, code=0):
        """What one command prints, with the exit code that it is to have.

        In this process, because there are many of them; what is attended has one of its own.
        """
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            found = ctl_module.main(["--data-dir", str(self._lab.data), "demo", *words])
        assert found == code, (words, out.getvalue(), err.getvalue())
        return err.getvalue() if code else out.getvalue()

    def status(self):
        return self._lab.client.status()

    def joints(self):
        """Where the robot is told to be: [D]."""
        return np.array(self._lab.client.query("aim").data["joints"])

    @contextlib.contextmanager
    def attended(self, mode, *words):
        """A run in another terminal, without a person at it; it ends when it is stopped, with exit code 0."""
        run = subprocess.Popen(
            [*self._words, "run", "--mode", mode, *words],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert f"RUNNING ({mode}" in self("wait", IDLE_PHASE[mode])
            yield
            self("stop")
            out, err = run.communicate()
            assert (run.returncode, err) == (0, "")
            assert "READY" in out.splitlines()[-1]
        finally:
            if run.poll() is None:
                run.send_signal(signal.SIGKILL)
                run.communicate()

    @contextlib.contextmanager
    def at_the_keyboard(self, mode):
        """A run with a person at its terminal: how to press a key, and what is shown; it is to end well."""
        ours, theirs = pty.openpty()
        screen = bytearray()
        run = subprocess.Popen(
            [*self._words, "run", "--mode", mode],
            cwd=ROOT,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(theirs)

        def shown():
            with contextlib.suppress(OSError):  # it has ended
                while select.select([ours], [], [], 0)[0]:
                    screen.extend(os.read(ours, 4096))
            return screen.decode()

        try:
            self("wait", "waiting")
            eventually(lambda: "q: stop]" in shown(), "the keys")
            yield lambda key: os.write(ours, key.encode()), shown
            eventually(lambda: shown() is not None and run.poll() is not None, "the end")
            assert run.returncode == 0, shown()
        finally:
            if run.poll() is None:
                run.send_signal(signal.SIGKILL)
                run.wait()
            shown()
            os.close(ours)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    made = Lab(tmp_path_factory.mktemp("lab"))
    try:
        made.up("strategy.execution_horizon=8", "setup.observation_timeout_s=3.0")
        made.client.close()
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def ctl(lab):
    made = Terminal(lab)
    assert "READY" in made("setup", "--task", "fold the cloth")
    return made


pytestmark = [pytest.mark.slow, pytest.mark.lab]


def joints_of(lab):
    """What the station publishes of one control step."""
    subscriber = lab.client.subscribe("joints")
    try:
        return subscriber.receive(5.0)["joints"]
    finally:
        subscriber.close()


def test_status_says_what_there_is(ctl):
    eventually(lambda: "drives    enabled" in ctl("status"), "the drives are reported")
    told = ctl("status")
    assert "task      fold the cloth" in told
    assert "first     the policy's first action is" in told


def test_steps_are_asked_for_one_by_one_and_each_is_over_when_the_terminal_says_so(ctl):
    with ctl.attended("step"):
        before = ctl.joints()
        for _ in range(2):
            assert "waiting" in ctl("step", "--wait")
            after = ctl.joints()
            assert np.abs(after - before).max() > 0
            before = after
        assert ctl.status()["policy"]["answers"] == 2
        assert json.loads(ctl("status", "--json"))["mode"] == "step"
        assert "move is for manual" in ctl("move", "--pose", "home", code=1)
    assert ctl.status()["state"] == "ready"


def test_a_chunk_is_shown_then_committed_or_cancelled(ctl):
    with ctl.attended("preview"):
        assert "no chunk is shown: step first" in ctl("commit", code=1)
        assert "proposed" in ctl("step", "--wait")
        before = ctl.joints()
        assert ctl.status()["proposal"]["rows"] > 0
        assert "waiting" in ctl("commit", "--wait")
        assert np.abs(ctl.joints() - before).max() > 0
        ctl("step", "--wait")
        assert "waiting" in ctl("cancel", "--wait")
        assert ctl.status()["proposal"] == {}


def test_a_person_at_the_terminal_steps_with_single_keys(ctl):
    with ctl.at_the_keyboard("step") as (press, shown):
        press("\n")
        eventually(lambda: "(step, executing)" in shown(), "the chunk")
        ctl("wait", "waiting")
        press("c")
        eventually(lambda: "commit is for preview" in shown(), "the refusal")
        press("q")
    assert "[Enter: next chunk, x: cancel, q: stop]" in shown()


def test_a_person_moves_jogs_and_grips(ctl):
    with ctl.attended("manual"):
        there = ctl.joints()
        ctl("move", "--joint", "left_arm.joint0+=0.1", "--wait")
        np.testing.assert_allclose(ctl.joints()[0] - there[0], 0.1, atol=1e-4)
        ctl("move", "--pose", "home", "--wait")
        asked = ("--xyz", "0,0,15", "--rpy", "0,0,5")
        aim = json.loads(ctl("aim", "--arm", "left_arm", *asked, "--json"))
        assert aim["reached"]
        assert "left_arm.joint" in ctl("jog", "left_arm", *asked, "--wait")
        np.testing.assert_allclose(ctl.joints(), aim["joints"], atol=1e-4)
        assert "it cannot go there" in ctl("jog", "left_arm", "--xyz", "2000,0,0", code=1)
        ctl("gripper", "open", "--arm", "right_arm", "--wait")
        ctl("gripper", "lock", "--arm", "right_arm")
        assert ctl.status()["grippers"]["right_arm"]["locked"]
        ctl("gripper", "unlock")
        assert not ctl.status()["grippers"]["right_arm"]["locked"]
        assert "has grippers on left_arm, right_arm" in ctl("gripper", "open", "--arm", "third", code=1)
        assert "step is for step and preview" in ctl("step", code=1)


def test_a_simulation_moves_no_robot_and_is_tuned_while_it_runs(ctl, lab):
    measured = joints_of(lab)["measured"]
    with ctl.attended("sim", "--sim-state", "simulated"):
        assert "the policy sees the simulated state" in ctl("status")
        assert "sync" in ctl("tune", "--strategy", "sync", "--set", "execution_horizon=4")
        eventually(lambda: lab.client.status()["policy"]["answers"] > 3, "chunks in the simulation")
        assert "strategy.k_max = 'many'" in ctl("tune", "--set", "k_max=many", code=1)
        assert ctl.status()["tuning"]["execution_horizon"] == 4
        assert np.abs(joints_of(lab)["simulated"] - measured).max() > 0.05
    np.testing.assert_allclose(joints_of(lab)["measured"], measured, atol=5e-3)


def test_drives_that_are_off_are_said_and_keep_it_from_being_set_up(ctl, lab):
    node = lab.addresses["node"]["action_endpoint"]
    assert drives.main(["fault", "--fault", "axis 2 is hot", "--action-endpoint", node]) == 0
    eventually(lambda: ctl.status()["drives"].get("faults") == ["axis 2 is hot"], "the fault")
    assert "drives    DISABLED; fault: axis 2 is hot" in ctl("status")
    assert "axis 2 is hot" in ctl("setup", code=1)
    assert drives.main(["enable", "--action-endpoint", node]) == 0
    eventually(lambda: ctl.status()["drives"] == {"enabled": True, "faults": []}, "enabled drives")
    told = ctl("events", "--kind", "drives")
    assert "drives disabled; drive fault: axis 2 is hot" in told
    assert "drives enabled; drive fault gone: axis 2 is hot" in told


def test_what_has_happened_can_be_listed_and_the_estop_pressed_and_released(ctl):
    assert "tuned_to" in ctl("events", "--kind", "tuned_to", "--last", "1")
    assert "done" in ctl("estop", "end of the story")
    assert "allowed: release" in ctl("run", code=1)
    assert "IDLE" in ctl("release")
