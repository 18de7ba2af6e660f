import math
from dataclasses import replace
from itertools import count, product
from typing import get_type_hints

import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import BenchRequest, LabelRequest, RunRequest, SetUpRequest
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.operations import SessionActions, SessionComponents
from runtime.processes.coordinator.session import machine as session_module
from runtime.processes.coordinator.session.machine import SessionMachine
from runtime.processes.coordinator.session.transitions import (
    COMMANDS,
    EVENT_TRANSITIONS,
    STOPPING,
    GuardFacts,
    SessionEvent,
)

S, H = SessionState, SessionEvent
EFFECTS = {
    "setup": "begin_setup",
    "run": "begin_run",
    "stop": "end_run",
    "halt": "hold",
    "resume": "resume_run",
    "home": "go_home",
    "release": "shared.request_release",
    "record_start": "start_recording",
    "record_stop": "runs.stop_standalone_recording",
    "tune": "tune",
    "step": "inference.step",
    "commit": "inference.commit",
    "cancel": "cancel",
    "move": "manual.move",
    "gripper": "move_gripper",
    "approach": "approach",
    "arm": "arm",
    "disarm": "collecting.disarm",
    "label": "collecting.label",
    "discard": "discard",
}
TOLD = {"begin_setup": {"bench": "bench-7"}, "begin_run": {"episode": "episode-7"}} | {
    "start_recording": {"episode": "episode-8"}
}
ARGUMENTS = {"gripper": {"action": "open"}, "label": {"result": "success"}}  # where one is needed
# Written out a second time, so that a change of the table is a decision and not a slip.
ALLOWED = {
    S.DISCONNECTED: {"record_stop", "estop"},
    S.IDLE: {"setup", "record_start", "record_stop", "tune", "estop"},
    S.SETTING_UP: {"stop", "halt", "record_stop", "estop"},
    S.READY: {"setup", "run", "stop", "home", "record_start", "record_stop", "tune", "gripper", "estop"},
    S.RUNNING: {"stop", "halt", "tune", "gripper", "estop"},
    S.HOLDING: {"stop", "halt", "resume", "record_stop", "tune", "gripper", "estop"},
    S.FAULTED: {"release", "estop"},
}
ON_DEMAND = ("step", "preview")
# What a situation adds while a run goes on or the station is ready, and what it takes away.
GUARDED = {
    "step": (
        S.RUNNING,
        lambda s: s.mode in ON_DEMAND and not (s.has_proposal or s.is_requesting or s.executing or s.opening),
    ),
    "commit": (S.RUNNING, lambda s: s.mode == "preview" and s.has_proposal and not s.approaching),
    "cancel": (S.RUNNING, lambda s: s.mode in (*ON_DEMAND, "manual") and not s.opening),
    "move": (S.RUNNING, lambda s: s.mode == "manual" and not s.opening),
}
PLACED = {
    "run",
    "resume",
    "home",
    "step",
    "commit",
    "move",
    "gripper",
    "approach",
}  # they begin to move the robot
MODES = (None, "continuous", "step", "preview", "sim", "manual")
SITUATIONS = [
    *(GuardFacts(*fields) for fields in product(MODES, *[(False, True)] * 7)),
    *(
        GuardFacts(mode, collection=collection, collecting=collecting, armed=armed, leader_problem=unled)
        for mode, collection, collecting, armed, unled in product(
            (None, "collect", "manual"), *[(False, True)] * 3, ("", "the leader is silent")
        )
    ),
    *(
        GuardFacts(mode, has_proposal=proposed, first_action=True, doubt="a reads 0.9 rad and is held at 0.0")
        for mode, proposed in product(MODES, (False, True))
    ),
]


def allowed_in(state, situation):
    """What may be given, said in another way than by the table."""
    found = set(ALLOWED[state])
    if situation.trial:
        found -= {"tune", "gripper"}
    if situation.opening and state is S.RUNNING:
        found.discard("gripper")
    found |= {kind for kind, (where, holds) in GUARDED.items() if state is where and holds(situation)}
    if situation.collecting and not situation.armed:
        found.discard("run")
    if situation.mode == "collect" and not situation.armed:
        found.discard("resume")
    if situation.collection:
        found |= {"label", "discard"}
        switched = "disarm" if situation.armed else "arm"
        possible = situation.armed or (situation.collecting and not situation.leader_problem)
        found |= {switched} if possible and state in (S.READY, S.HOLDING) else set()
    if situation.doubt:
        return found - PLACED
    committable = situation.mode == "preview" and situation.has_proposal
    if (state is S.READY and situation.first_action) or (state is S.RUNNING and committable):
        found.add("approach")
    return found


class Asked:
    """A method of the actions, or of one of their parts, by its name."""

    def __init__(self, recorded, name):
        self._recorded, self._name = recorded, name

    def __getattr__(self, name):
        return Asked(self._recorded, f"{self._name}.{name}")

    def __call__(self, *details):
        if self._name in self._recorded.refuse:
            raise RuntimeFault(f"cannot {self._name}")
        self._recorded.done.append((self._name, *details))
        return TOLD.get(self._name)


class Recorded:
    """Remembers what was asked for; refuses what it is told to."""

    situation = GuardFacts()

    def __init__(self):
        self.done, self.refuse = [], set()

    def set_requester(self, by, command):
        self.by = by

    def __getattr__(self, name):
        return Asked(self, name)


class Bench:
    """A session with a lease held by anna, in any state."""

    def __init__(self, state=S.DISCONNECTED):
        self.clock, self.effects, self.lease = VirtualClock(100.0), Recorded(), Lease(5.0)
        self.session = SessionMachine(self.effects, self.lease, "boot-1", self.clock.now)
        self.session.state = state
        self._uuids = (f"uuid-{n}" for n in count())
        self.give("lease_claim")

    def command(self, kind, **changes):
        decided = Command(
            next(self._uuids),
            kind,
            holder="anna",
            epoch=self.lease.epoch,
            boot="boot-1",
            sequence=self.session.sequence,
            valid_until=self.clock.now() + 1.0,
        )
        return replace(decided, **changes)

    def give(self, kind, **changes):
        changes = ({"epoch": 0} if kind == "lease_claim" else {}) | changes
        return self.session.handle(self.command(kind, **changes))

    @property
    def names(self):
        return [done[0] for done in self.effects.done]


@pytest.mark.parametrize("state", SessionState)
def test_what_is_allowed_in_a_state_is_what_its_guards_say_in_every_situation(state):
    bench = Bench(state)
    for situation in SITUATIONS:
        bench.effects.situation = situation
        allowed, guarded = set(bench.session.allowed()), bench.session.blocked_commands()
        assert allowed == allowed_in(state, situation), situation
        of_the_state = {kind for kind, rule in COMMANDS.items() if state in rule.allowed}
        assert set(guarded) == of_the_state - allowed, situation
        assert all(guarded.values()), situation


@pytest.mark.parametrize(("kind", "state"), list(product(COMMANDS, SessionState)))
def test_a_command_is_carried_out_exactly_where_table_and_guards_allow_it(kind, state):
    cancels = state is S.SETTING_UP and kind in ("stop", "halt")
    for situation in SITUATIONS:
        bench = Bench(state)
        bench.effects.situation = situation
        sequence = bench.session.sequence
        ack = bench.give(kind, args=ARGUMENTS.get(kind, {}))
        if kind not in allowed_in(state, situation):
            assert ack.status == "refused"
            assert ack.reason.startswith(f"{kind} is not allowed ")
            assert f"allowed: {', '.join(ack.allowed)}" in ack.reason
            assert set(ack.allowed) == allowed_in(state, situation)
            assert bench.session.state is state
            assert bench.session.sequence == sequence
            assert bench.effects.done == []
            continue
        after = S.IDLE if cancels else COMMANDS[kind].next(state) or state
        assert (ack.status, ack.reason) == ("accepted", "")
        assert bench.names == ["cancel_setup" if cancels else EFFECTS[kind]]
        assert bench.session.state is after
        assert ack.sequence == bench.session.sequence
        assert (bench.session.sequence > sequence) == (cancels or COMMANDS[kind].next(state) is not None)


@pytest.mark.parametrize("name", ["hold", "end_run", "cancel_setup", *EFFECTS.values()])
def test_what_carries_out_a_command_is_a_method_of_the_actions_or_of_one_of_their_parts(name):
    *part, method = name.split(".")
    carries_out = get_type_hints(SessionComponents)[part[0]] if part else SessionActions
    assert callable(getattr(carries_out, method))


def test_a_session_is_connected_while_complete_observations_arrive_whatever_its_state_is():
    bench = Bench(S.DISCONNECTED)

    def after(*happenings):
        for happening in happenings:
            bench.session.handle_event(happening)
        told = bench.session.state_meaning()
        return [name for name in ("connected", "latched", "idle") if told[name]]

    assert after(H.ESTOPPED) == ["latched"]
    assert after(H.CONNECTED) == ["connected", "latched"]
    assert after(H.INCOMPLETE, H.RELEASED) == []
    assert after(H.CONNECTED) == ["connected", "idle"]
    assert after(H.ESTOPPED, H.LINK_LOST) == ["latched"]


def test_a_refusal_names_the_state_or_what_the_guard_says():
    bench = Bench(S.IDLE)
    assert bench.give("step").reason.startswith("step is not allowed while idle (")
    bench = Bench(S.RUNNING)
    bench.effects.situation = GuardFacts(mode="preview", has_proposal=True)
    assert "a chunk is shown: commit or cancel it first" in bench.give("step").reason
    bench.effects.situation = GuardFacts(mode="continuous", trial=True)
    assert "one of a trial" in bench.give("tune").reason


def test_what_collects_is_refused_with_what_is_missing():
    bench = Bench(S.READY)
    assert "its deployment has no [collection]" in bench.give("arm").reason
    bench.effects.situation = GuardFacts(collection=True)
    assert "set up with collect first" in bench.give("arm").reason
    bench.effects.situation = GuardFacts(
        collection=True, collecting=True, leader_problem="the leader is silent"
    )
    assert "the leader is silent" in bench.give("arm").reason
    assert "not armed: arm first" in bench.give("run").reason
    bench = Bench(S.HOLDING)
    bench.effects.situation = GuardFacts(mode="collect", collection=True, collecting=True)
    assert "arm first, or stop" in bench.give("resume").reason


@pytest.mark.parametrize("state", SessionState)
def test_discarding_what_goes_on_ends_it_and_discarding_what_is_named_ends_nothing(state):
    collects = GuardFacts(mode="collect", collection=True, collecting=True, armed=True)
    named, open_one = Bench(state), Bench(state)
    named.effects.situation = open_one.effects.situation = collects
    named.give("discard", args={"episode": "e"})
    assert named.session.state is state
    open_one.give("discard")
    assert open_one.session.state is (S.READY if state in (S.RUNNING, S.HOLDING) else state)


def test_an_effect_knows_who_gave_the_command():
    bench = Bench(S.READY)
    bench.effects.situation = GuardFacts(collection=True)
    bench.give("label", args={"result": "fail", "note": "dropped"}, user="ben")
    assert bench.effects.done == [("collecting.label", LabelRequest(result="fail", note="dropped"), "ben")]


def test_going_to_the_first_action_is_a_set_up_of_its_own_but_within_a_run_the_run_goes_on():
    bench = Bench(S.READY)
    bench.effects.situation = GuardFacts(first_action=True)
    bench.give("approach")
    assert bench.session.state is S.SETTING_UP
    bench = Bench(S.RUNNING)
    bench.effects.situation = GuardFacts(mode="preview", has_proposal=True)
    bench.give("approach")
    assert bench.session.state is S.RUNNING


@pytest.mark.parametrize(
    ("kind", "state"), [(k, s) for s in SessionState for k in sorted(ALLOWED[s] - {"estop"})]
)
def test_an_effect_that_refuses_is_the_reason_and_nothing_changes(kind, state):
    bench = Bench(state)
    cancels = state is S.SETTING_UP and kind in ("stop", "halt")
    name = "cancel_setup" if cancels else EFFECTS[kind]
    bench.effects.refuse = {name}
    sequence, reason = bench.session.sequence, bench.session.reason
    ack = bench.give(kind, args=ARGUMENTS.get(kind, {}))
    assert (ack.status, ack.reason) == ("refused", f"cannot {name}")
    assert (bench.session.state, bench.session.sequence, bench.session.reason) == (state, sequence, reason)


def test_the_arguments_of_a_command_reach_its_effect_checked():
    bench = Bench(S.READY)
    bench.give("run", args={"trial": {"scene": 3}, "operator": "anna", "duration_s": 20})
    bench.session.state = S.READY
    bench.give("setup", args={"task": "stack", "bench": {"seed": 4}})
    run, setup = (asked for _, asked in bench.effects.done)
    assert run == RunRequest(trial={"scene": 3}, operator="anna", duration_s=20.0)
    assert setup == SetUpRequest(task="stack", bench=BenchRequest(seed=4))


@pytest.mark.parametrize("kind", [kind for kind in COMMANDS if kind not in STOPPING])
def test_an_argument_that_a_command_does_not_take_is_the_reason_and_nothing_is_done(kind):
    state = COMMANDS[kind].allowed[0]
    bench = Bench(state)
    bench.effects.situation = next(s for s in SITUATIONS if kind in allowed_in(state, s))
    sequence = bench.session.sequence
    ack = bench.give(kind, args=ARGUMENTS.get(kind, {}) | {"colour": "blue"})
    assert ack.status == "refused"
    assert ack.reason.startswith((f"{kind}: colour = 'blue': unknown key", f"{kind} takes no arguments"))
    assert (bench.session.state, bench.session.sequence, bench.effects.done) == (state, sequence, [])


@pytest.mark.parametrize("kind", ["stop", "halt"])
@pytest.mark.parametrize("state", [S.RUNNING, S.HOLDING, S.SETTING_UP])
def test_a_stop_is_not_refused_for_a_word_too_many(kind, state):
    assert Bench(state).give(kind, args={"colour": "blue"}).status == "accepted"


def test_what_an_effect_tells_is_in_the_answer_beside_the_lease():
    lease = {"epoch": 1, "holder": "anna"}
    assert Bench(S.READY).give("run").data == {"episode": "episode-7"} | lease
    assert Bench(S.READY).give("setup").data == {"bench": "bench-7"} | lease
    assert Bench(S.READY).give("record_start").data == {"episode": "episode-8"} | lease
    assert Bench(S.READY).give("stop").data == lease
    assert Bench(S.IDLE).give("run").data == lease  # refused: nothing was told


@pytest.mark.parametrize("state", SessionState)
def test_an_unknown_command_is_refused_with_the_known_ones(state):
    ack = Bench(state).give("dance")
    assert ack.status == "refused"
    assert ack.reason.startswith("unknown command 'dance'; known: setup, run, stop")


@pytest.mark.parametrize("state", SessionState)
def test_the_estop_is_sent_on_to_its_own_socket_by_anybody(state):
    bench = Bench(state)
    ack = bench.give("estop", holder="", epoch=0, boot="", sequence=-1, valid_until=0.0)
    assert (ack.status, ack.reason) == ("refused", "the e-stop has a socket of its own: send it to the guard")
    assert bench.session.state is state


STALE = {
    "another boot": ({"boot": "boot-0"}, "stale: it was decided before the runtime was restarted"),
    "an older state": ({"sequence": 0}, "stale: the state has changed since it was decided"),
    "a deadline that has passed": ({"valid_until": 99.9}, "stale: it arrived after its deadline"),
    "no deadline at all": ({"valid_until": math.nan}, "stale: it arrived after its deadline"),
}


@pytest.mark.parametrize(("changes", "reason"), STALE.values(), ids=STALE.keys())
@pytest.mark.parametrize("kind", [kind for kind in COMMANDS if kind not in STOPPING])
def test_what_was_decided_by_something_old_is_refused_as_stale(kind, changes, reason):
    state = COMMANDS[kind].allowed[0]
    bench = Bench(state)
    ack = bench.give(kind, **changes)
    assert ack.status == "refused"
    assert ack.reason.startswith(reason)
    assert (bench.session.state, bench.effects.done) == (state, [])


@pytest.mark.parametrize("kind", ["stop", "halt"])
@pytest.mark.parametrize("changes", [changes for changes, _ in STALE.values()], ids=STALE.keys())
def test_a_stopping_command_is_never_stale(kind, changes):
    bench = Bench(S.RUNNING)
    assert bench.give(kind, **changes).status == "accepted"
    assert bench.session.state is COMMANDS[kind].after


@pytest.mark.parametrize("kind", COMMANDS)
def test_every_command_needs_the_lease(kind):
    bench = Bench(COMMANDS[kind].allowed[0])
    assert bench.give(kind, holder="ben").reason == "anna holds the lease"
    assert bench.give(kind, epoch=7).reason == "epoch 7 is not the lease's epoch 1"
    bench.clock.advance(5.0)
    assert bench.give(kind).reason == "the station has no operator: take it first"
    assert bench.effects.done == []


@pytest.mark.parametrize(
    ("state", "kind", "after"),
    [
        (S.RUNNING, "stop", S.READY),
        (S.RUNNING, "halt", S.HOLDING),
        (S.SETTING_UP, "stop", S.IDLE),
        (S.HOLDING, "stop", S.READY),
    ],
)
def test_the_panel_stops_whoever_holds_the_lease_and_does_nothing_else(state, kind, after):
    bench = Bench(state)
    at_the_panel = {"holder": "panel:127.0.0.1", "role": "local"}
    assert bench.give("resume", **at_the_panel).reason == "anna holds the lease"
    assert bench.give(kind, **at_the_panel | {"role": "operator"}).reason == "anna holds the lease"
    assert bench.give(kind, **at_the_panel).status == "accepted"
    assert bench.session.state is after


def test_a_program_that_drives_may_be_stopped_by_others_and_commanded_by_it_alone():
    bench = Bench(S.RUNNING)
    bench.clock.advance(5.0)
    assert bench.give("lease_claim", holder="robot:theirs#0", epoch=2).status == "accepted"
    assert bench.give("resume", holder="ben").reason == "robot:theirs#0 holds the lease"
    assert bench.give("stop", holder="ben").status == "accepted"
    assert bench.session.state is S.READY


def test_a_run_that_nobody_commands_takes_stops_of_everybody_and_no_other_command():
    bench = Bench(S.RUNNING)
    bench.clock.advance(5.0)
    assert bench.session.handle_event(H.HOLDER_LOST, "nobody commands")
    assert (bench.session.state, bench.session.reason) == (S.RUNNING, "nobody commands")
    assert bench.effects.done == []
    refused = {bench.give(kind, holder="ben").reason for kind in COMMANDS if kind not in STOPPING}
    assert refused == {"the station has no operator: take it first"}
    assert bench.give("halt", holder="ben").status == "accepted"
    assert bench.give("stop", holder="ben").reason == "the station has no operator: take it first"


def test_who_claims_a_run_that_nobody_commands_has_it_as_it_goes_on():
    bench = Bench(S.RUNNING)
    bench.clock.advance(5.0)
    bench.session.handle_event(H.HOLDER_LOST, "nobody commands")
    assert bench.give("lease_claim", holder="ben").status == "accepted"
    assert (bench.session.state, bench.session.reason) == (S.RUNNING, "")
    assert bench.give("stop").reason == "ben holds the lease"
    assert bench.give("stop", holder="ben").status == "accepted"


def test_of_two_commanders_only_the_newer_epoch_commands():
    bench = Bench(S.READY)
    assert bench.give("lease_claim", holder="ben", epoch=0).status == "refused"
    taken = bench.give("lease_claim", holder="ben", epoch=2)
    assert (taken.status, taken.data) == ("accepted", {"epoch": 2, "holder": "ben"})
    assert bench.give("run", epoch=1).reason == "ben holds the lease"
    assert bench.give("run", holder="ben", epoch=2).status == "accepted"
    assert bench.give("stop", epoch=1).reason == "ben holds the lease"


def test_a_command_decided_before_the_lease_changed_hands_is_stale():
    bench = Bench(S.READY)
    decided = bench.command("run")
    bench.give("lease_claim", holder="ben", epoch=2)
    bench.give("lease_claim", epoch=3)
    ack = bench.session.handle(replace(decided, epoch=3))
    assert ack.reason.startswith("stale: the state has changed")


def test_keeping_a_lease_makes_nothing_stale():
    bench = Bench(S.READY)
    decided = bench.command("run")
    bench.give("lease_renew")
    bench.give("lease_claim")
    assert bench.session.handle(decided).status == "accepted"


@pytest.mark.parametrize("state", list(S))
def test_a_hidden_page_keeps_its_lease_while_nothing_moves(state):
    bench = Bench(state)
    ack = bench.give("lease_renew", args={"hidden": True})
    if state.meaning.moving:
        assert ack.reason == "the page of the lease's holder is hidden while the robot moves"
    assert ack.status == ("refused" if state.meaning.moving else "accepted")
    assert bench.give("lease_renew").status == "accepted"


def test_a_lease_can_be_claimed_by_who_knows_nothing_yet():
    bench = Bench()
    bench.clock.advance(5.0)
    ack = bench.give("lease_claim", holder="ben", boot="", sequence=0, valid_until=0.0)
    assert (ack.status, ack.data["holder"], ack.data["epoch"]) == ("accepted", "ben", 2)


def test_a_repeated_uuid_gets_the_first_answer_and_is_not_carried_out_again():
    bench = Bench(S.READY)
    command = bench.command("run")
    first = bench.session.handle(command)
    bench.give("stop")
    assert bench.session.handle(command) is first
    assert bench.names == ["begin_run", "end_run"]
    assert bench.session.state is S.READY


def test_a_stop_under_the_uuid_of_a_run_is_obeyed_and_any_other_command_refused():
    bench = Bench(S.READY)
    bench.give("run", uuid="same")
    assert bench.give("halt", uuid="same").status == "accepted"
    assert bench.session.state is S.HOLDING
    answer = bench.give("resume", uuid="same")
    assert (answer.status, answer.reason) == ("refused", "its uuid was given to the command 'run' before")
    assert bench.session.state is S.HOLDING
    assert bench.give("stop", uuid="same").status == "accepted"
    assert bench.session.state is S.READY


def test_a_repeated_refusal_is_the_same_refusal():
    bench = Bench(S.IDLE)
    command = bench.command("run")
    first = bench.session.handle(command)
    bench.session.state = S.READY
    assert bench.session.handle(command) is first
    assert first.status == "refused"


def test_answers_of_before_a_restart_are_given_again_and_their_epochs_are_over():
    bench = Bench(S.READY)
    before = Ack("old", "accepted", boot="boot-0", data={"epoch": 12, "holder": "anna"})
    bench.session.restore_answers({"old": before, "odd": Ack("odd", "refused", data={"epoch": "x"})})
    assert bench.session.handle(bench.command("run", uuid="old")) is before
    assert bench.effects.done == []
    assert bench.lease.epoch == 12


def test_commands_without_a_uuid_are_not_taken_for_repetitions_of_each_other():
    bench = Bench(S.RUNNING)
    assert bench.give("resume", uuid="").reason == "a command needs a uuid of its own"
    assert bench.give("stop", uuid="").reason == "a command needs a uuid of its own"
    assert bench.give("stop").status == "accepted"


def test_renewals_are_a_stream_and_not_remembered():
    bench = Bench(S.READY)
    assert bench.give("lease_renew", uuid="same").status == "accepted"
    bench.clock.advance(5.0)
    assert bench.give("lease_renew", uuid="same").status == "refused"


def test_memory_is_bounded_and_forgets_the_oldest_answer(monkeypatch):
    monkeypatch.setattr(session_module, "ANSWERS_KEPT", 3)
    bench = Bench(S.IDLE)
    first = bench.session.handle(bench.command("run", uuid="first"))
    newest = [bench.session.handle(bench.command("run", uuid=f"later-{n}")) for n in range(3)]
    assert bench.session.handle(bench.command("run", uuid="later-0")) is newest[0]
    assert bench.session.handle(bench.command("run", uuid="first")) is not first


EXPECTED_EFFECTS = {
    H.HELD: ["hold"],
    H.LEASE_ENDED: ["hold"],
    H.LINK_LOST: ["hold"],
    H.ESTOPPED: ["end_run"],
    H.FAMILY_DIED: ["end_run"],
    H.RUN_ENDED: ["end_run"],
    H.RUN_FAILED: ["end_run"],
}


@pytest.mark.parametrize(("happening", "state"), list(product(SessionEvent, SessionState)))
def test_what_happens_changes_the_state_as_the_table_says_and_in_no_other_case(happening, state):
    bench = Bench(state)
    sequence = bench.session.sequence
    changed = bench.session.handle_event(happening, "because")
    after = EVENT_TRANSITIONS.get((happening, state))
    assert changed == (after is not None)
    if after is None:
        assert (bench.session.state, bench.session.sequence) == (state, sequence)
        # A gripper may be on its way although no run goes on: nobody would be there to stop it.
        stops = happening is H.LEASE_ENDED and state in (S.READY, S.HOLDING)
        assert bench.names == ["hold"] * stops
        return
    assert (bench.session.state, bench.session.reason) == (after, "because")
    assert bench.session.sequence == sequence + 1
    cancels = state is S.SETTING_UP and happening not in (H.SETUP_DONE, H.SETUP_FAILED)
    assert bench.names == ["cancel_setup"] * cancels + EXPECTED_EFFECTS.get(happening, [])


@pytest.mark.parametrize(
    ("happening", "status"),
    [
        (H.RUN_ENDED, "finished"),
        (H.RUN_FAILED, "failed"),
        (H.ESTOPPED, "interrupted"),
        (H.FAMILY_DIED, "interrupted"),
    ],
)
def test_a_run_is_closed_with_the_status_of_what_ended_it(happening, status):
    bench = Bench(S.RUNNING)
    bench.session.handle_event(happening, "because")
    assert bench.effects.done == [("end_run", status, "because")]


@pytest.mark.parametrize("state", [s for s in SessionState if s is not S.FAULTED])
def test_the_estop_faults_every_state_and_only_its_release_leads_out(state):
    bench = Bench(state)
    bench.session.handle_event(H.ESTOPPED, "e-stop by anna")
    for happening in set(SessionEvent) - {H.RELEASED}:
        bench.session.handle_event(happening, "because")
        assert bench.session.state is S.FAULTED
    bench.give("release")
    assert bench.session.state is S.FAULTED  # until the guard has released
    bench.session.handle_event(H.RELEASED, "released")
    assert bench.session.state is S.IDLE


def test_nothing_that_happens_starts_a_motion():
    for happening, state in product(SessionEvent, SessionState):
        bench = Bench(state)
        bench.session.handle_event(happening, "because")
        assert not {"begin_setup", "begin_run", "resume_run", "go_home"} & set(bench.names)
        assert bench.session.state is state or bench.session.state not in (S.RUNNING, S.SETTING_UP)


def test_the_end_of_the_lease_holds_a_run_and_leaves_it_open():
    bench = Bench(S.RUNNING)
    bench.session.handle_event(H.LEASE_ENDED, "not renewed")
    assert bench.session.state is S.HOLDING
    assert bench.effects.done == [("hold", "not renewed")]
    assert "resume" in bench.session.allowed()


def test_a_fault_of_an_effect_passes_through_where_nobody_can_be_refused():
    bench = Bench(S.RUNNING)
    bench.effects.refuse = {"hold"}
    with pytest.raises(RuntimeFault, match="cannot hold"):
        bench.session.handle_event(H.HELD, "because")
    assert bench.session.state is S.RUNNING
