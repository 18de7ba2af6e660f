"""People at the station without a browser: the REST and the live socket that a page uses, and nothing else."""

import uuid
from contextlib import contextmanager

import pytest

from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.stall_detection import DemoFailed
from tests.e2e.lab import STATION
from tests.processes import PATIENCE_S, eventually

SCENE, SKILLED = "block-on-plate", "pick-place-40k"


def visitor(demo, username, password=None):
    """Somebody who has logged in."""
    found = RestClient(demo.url)
    found.login(username, password or demo.passwords[username])
    return found


def refusal(ask):
    """The sentence with which `ask()` is refused."""
    with pytest.raises(DemoFailed) as refused:
        ask()
    return str(refused.value)


def was_late(reason):
    """Whether a state was refused as too old, which a machine that has too much to do brings about."""
    return "s old (limit" in reason or "have not been seen for" in reason


class RestPage(LivePage):
    """A page of somebody at the station; `told` has every message but frames."""

    def __init__(self, visitor, page=""):
        self.told = []
        self.visitor = visitor
        super().__init__(visitor, STATION, page)

    def again(self):
        """The same page after its connection broke: same name, same lease."""

        page = opened(self.visitor, self.page)
        page.epoch = self.epoch
        return page

    def take(self):
        self.claim()
        self.wait(lambda state: state["lease"]["epoch"] == self.epoch, PATIENCE_S, "having the station")

    def state(self):
        """The newest state."""
        return self.wait(lambda state: True, PATIENCE_S, "any state")

    def command(self, kind, trial=None):
        """As a page's operator gives it, who does as a refusal says that it passes by itself."""

        def given():
            try:
                return super(RestPage, self).command(kind, trial)
            except DemoFailed as refusal:
                if "try again in a moment" not in str(refusal):
                    raise

        return eventually(given, f"{kind} is taken")

    def prepare(self, checkpoint=SKILLED, position=1):
        """The id of a new trial."""
        choice = {"scene": SCENE, "position": position, "checkpoint": checkpoint, "seed": 1}
        return self.visitor.post(f"stations/{STATION}/trials", choice)["id"]

    def set_up(self, trial):
        """Set up for this trial; once more where this machine was late."""

        def ready():
            self.command("setup", trial)
            state = self.wait(lambda state: state["state"] != "setting_up", PATIENCE_S, "setting up")
            assert state["state"] == "ready" or was_late(state["reason"]), state["reason"]
            return state["state"] == "ready"

        eventually(ready, "ready", 3 * PATIENCE_S)

    def running(self, checkpoint=SKILLED):
        """The id of a trial that has just begun to run."""
        trial = self.prepare(checkpoint)
        self.set_up(trial)
        self.command("run", trial)
        self.goes_on(trial)
        return trial

    def goes_on(self, trial):
        """The robot moves for this trial, and the record says so; resumed where this machine was late."""

        def moves():
            state = self.state()
            if state["state"] == "holding":
                self.command("resume", trial)
            recording = state["recording"]  # until it is told of this run its rows are those of the last one
            recorded = recording["uuid"] == state["run"]["uuid"] and recording["rows"] > 0  # else no episode
            return state["state"] == "running" and self.status(trial) == "running" and recorded

        eventually(moves, f"trial {trial} runs; the station is {self.state()['reason']}")

    def resume(self, trial):
        self.command("resume", trial)
        self.goes_on(trial)

    def holds(self, trial):
        """The reason for which the station holds, once the trial is paused as well."""
        reason = self.wait(lambda state: state["state"] == "holding", PATIENCE_S, "holding")["reason"]
        eventually(lambda: self.status(trial) == "paused", f"trial {trial} is paused")
        return reason

    def stop(self, trial):
        """Press Stop; the trial waits to be scored."""
        self.command("stop", trial)
        eventually(lambda: self.status(trial) == "ended", f"trial {trial} has ended")

    def score(self, trial, reached=False):
        milestones = self.visitor.get(f"scenes/{SCENE}")["milestones"]
        said = {str(milestone["id"]): reached for milestone in milestones}

        def scored():
            try:
                return self.visitor.post(f"trials/{trial}/score", {"milestones": said})
            except DemoFailed as refusal:  # the page says so too, and its operator presses again
                if "on the disk yet" not in str(refusal):
                    raise

        return eventually(scored, f"the recording of trial {trial} is on the disk")

    def status(self, trial):
        return self.trial(trial)["status"]

    def trial(self, trial):
        return self.visitor.get(f"trials/{trial}")

    def press(self, kind, **decided):
        """A command of this page's with other facts than the newest; returns what was sent and the answer."""
        state = self.state()
        content = {
            "uuid": str(uuid.uuid4()),
            "kind": kind,
            "page": self.page,
            "epoch": self.epoch,
            "boot": state["boot"],
            "sequence": state["sequence"],
        } | decided
        return self.visitor.post(f"stations/{STATION}/commands", content)

    def estop(self, why="pressed by a test"):
        """Press it over the live socket; returns the answer."""
        identity = str(uuid.uuid4())
        self.say({"type": "estop", "uuid": identity, "why": why})

        def answered():
            return [said for said in self.told if said.get("uuid") == identity]

        return eventually(answered, "the e-stop is answered")[0]

    def renewals(self):
        """How the runtime has answered to the page's signs of life."""
        return [said for said in self.told if said["type"] == "renewed"]

    def renewed(self):
        """Whether this page still has the station, by the answer to its first sign of life."""
        return eventually(self.renewals, "an answer to a renewal")[0]["ok"]

    def draws(self, frames):
        """So many more frames arrive."""
        wanted = self.frames + frames
        eventually(lambda: self.frames >= wanted, f"{frames} more frames")

    def say(self, message):
        """Over the live socket."""
        self._send(message)

    def _on_message(self, message):
        self.told.append(message)
        super()._on_message(message)


def opened(visitor, page=""):
    """A page, as soon as the web serves it; a browser tries again in the same way."""

    def tried():
        try:
            return RestPage(visitor, page)
        except DemoFailed:  # nobody listens yet
            return None

    return eventually(tried, "the web opens a live page", 3 * PATIENCE_S)


@contextmanager
def page_of(visitor):
    """A page on the station that is closed at the end."""
    page = opened(visitor)
    try:
        yield page
    finally:
        page.close()


def reset_station(admin):
    """Leave the station ready or idle, nobody's, without an open trial."""
    with page_of(admin) as page:
        page.wait(lambda state: state["state"] != "disconnected", PATIENCE_S, "the station")
        facts = admin.get(f"stations/{STATION}")
        if facts["trial"] is None and not facts["lease"]["holder"] and facts["snapshot"]["state"] in _AT_REST:
            return
        taken = {"action": "take", "page": page.page, "reason": "the next test begins"}
        page.epoch = admin.post(f"stations/{STATION}/lease", taken)["epoch"]
        page.wait(lambda state: state["lease"]["epoch"] == page.epoch, PATIENCE_S, "having the station")
        state = page.state()["state"]
        if state not in _AT_REST:
            page.command("release" if state == "faulted" else "stop")
        page.wait(lambda state: state["state"] in _AT_REST, PATIENCE_S, "the station at rest")
        eventually(lambda: _finished(admin), "no trial is open")
        admin.post(f"stations/{STATION}/lease", {"action": "give_up", "page": page.page})
        page.epoch = 0


_AT_REST = ("ready", "idle")


def _finished(admin):
    trial = admin.get(f"stations/{STATION}")["trial"]
    if trial is None:
        return True
    if trial["status"] == "prepared":
        admin.post(f"trials/{trial['id']}/abandon", {})
    elif trial["status"] == "ended":
        admin.post(f"trials/{trial['id']}/void", {"reason": "made by a test"})
    return False
