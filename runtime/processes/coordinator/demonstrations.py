"""Collection of demonstrations in the coordinator: arm switch, leader, episodes and their labels."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.core.clock import Clock
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import DiscardRequest, LabelRequest, RunRequest
from runtime.ipc.messages import EpisodeClosed, Event
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.processes.coordinator.setup.sequence import SetUp
from runtime.recording.labels import Label, append_label, latest_label
from runtime.recording.schema import Schema
from runtime.station.run import Run
from runtime.station.spec import StationSpec
from runtime.teleoperators.leader_policy import LeaderPolicy

_NOT_YET = fixed("collect.not_armed_yet", "not armed since set-up")
_NOT_SET_UP = fixed("collect.not_set_up", "the station is not set up to collect")
_SETUP_BEGUN = fixed("collect.setup_begun", "a set-up has begun")
_ARMED = fixed("collect.armed", "armed: the next demonstration may begin")
_DISARMED = Pattern("collect.disarmed", "disarmed: {why}")
_SHORT = Pattern(
    "collect.episode_short",
    "episode {episode} has {seconds:.1f} s, shorter than {least:g} s (collection.min_length_s)",
)
_NOBODY_DID_ANYTHING = Pattern(
    "collect.nobody_did_anything",
    "no activity for {minutes:g} minutes",
)
_NODE_NEVER_REPORTED = Pattern(
    "collect.node_never_reported",
    "the node reports no action within {seconds:g} s: does it have a leader, and is that connected?",
)
_NODE_SILENT = Pattern("collect.node_silent", "the node has reported no action for {seconds:.1f} s")
_LABELLED = Pattern("collect.labelled", "episode {episode}: {how}")
_OPEN_RUN_NO_DEMONSTRATION = fixed(
    "collect.open_run_no_demonstration",
    "the open run is no demonstration: name the episode",
)
_NONE_COLLECTED = fixed(
    "collect.none_collected",
    "no demonstration has been collected since the station started: name the episode",
)
_EPISODE_OPEN = Pattern(
    "collect.episode_open",
    "episode {episode} is the open one: leave `episode` out, or stop first",
)
_NO_SUCH_EPISODE = Pattern(
    "collect.no_such_episode",
    "episode = {episode!r}: there is no such episode here ({error})",
)
_NO_DEMONSTRATION = Pattern(
    "collect.no_demonstration",
    "episode = {episode!r} is a {kind}; allowed: demonstrations",
)

IDLE_S = 300.0  # [s] without activity until it is disarmed
_REMEMBERED = 64  # episodes that can be labelled before they are on disk
NODE_SILENT_S = 2.0  # [s] for a node to report an action
# Events that disarm, in any state of the session.
DISARMING = frozenset(
    {
        SessionEvent.HELD,
        SessionEvent.RUN_FAILED,
        SessionEvent.LEASE_ENDED,
        SessionEvent.LINK_LOST,
        SessionEvent.ESTOPPED,
        SessionEvent.FAMILY_DIED,
        SessionEvent.DISPLACED,
    }
)


class Demonstrations:
    """Demonstrations of a station.

    `armed` is True if a person has permitted the next demonstration to begin.
    """

    def __init__(
        self,
        spec: StationSpec,
        shared: SharedState,
        clock: Clock,
        inference: Inference,
        setup: SetUp,
        opened: Callable[[], Run | None],
        say: Callable[[Event], None],
    ) -> None:
        self._plan = spec
        self._settings = spec.deployment.collection
        self._data = spec.deployment.data
        self._shared_state, self._clock = shared, clock
        self._inference, self._setup = inference, setup
        self._opened = opened  # the open run
        self._say = say
        self.set_up = False
        self.armed = False
        self.why_not: str = _NOT_SET_UP
        self.task = ""  # of the newest episode, if its command had one
        self.last: dict[str, Any] | None = None
        self._asked: deque[str] = deque(maxlen=_REMEMBERED)  # uuids of the newest episodes
        self._touched = clock.now()
        self._reported_at: float | None = None  # capture time of the node's newest action
        self._reported: list[float] = []  # latest capture times, for their rate
        self._seen: dict[str, Any] | None = None  # the last known fingerprint

    # --- arm switch ------------------------------------------------------------------------------------------

    @property
    def declared(self) -> bool:
        """Whether the deployment configures collection."""
        return self._settings is not None

    @property
    def _relay(self) -> LeaderPolicy | None:
        policy = self._inference.policy
        return policy if isinstance(policy, LeaderPolicy) else None

    @property
    def _node_leads(self) -> bool:
        return self._settings is not None and self._settings.source == "node"

    @property
    def run(self) -> Run | None:
        """Open run if it collects a demonstration, else None."""
        run = self._opened()
        return run if run is not None and run.mode == "collect" else None

    @property
    def _newest(self) -> str:
        """Uuid of the newest demonstration since the station started, "" if there was none."""
        return self._asked[-1] if self._asked else ""

    @property
    def leader_problem(self) -> str:
        """Reason why the leader cannot be followed now, "" if there is none.

        It is also "" if that is unknown before the first request.
        """
        relay = self._relay
        return "" if relay is None else relay.leader_problem()

    def begin_setup(self, collects: bool) -> None:
        """Disarm, and record whether the set-up that begins is for collection or for a policy."""
        self.disarm(_SETUP_BEGUN)
        self.set_up = collects
        self.why_not = _NOT_YET if collects else _NOT_SET_UP

    def arm(self) -> None:
        """Arm: permit the next demonstration."""
        self.armed, self.why_not = True, ""
        self._event("collect_armed", _ARMED)

    def disarm(self, why: str) -> None:
        """Disarm, and emit the reason `why`; do nothing if not armed."""
        if self.armed:
            self.armed, self.why_not = False, why
            self._event("collect_disarmed", _DISARMED(why=why))

    def record_activity(self) -> None:
        """Record that a person was active."""
        self._touched = self._clock.now()

    def on_session_event(self, happening: SessionEvent, reason: str) -> None:
        """Disarm if no demonstration may begin after this event of the session."""
        if happening in DISARMING:
            self.disarm(reason)

    def poll(self, state: SessionState) -> tuple[SessionEvent, str] | None:
        """Check leader, node and activity; return an event for the session, or None."""
        now, run = self._clock.now(), self.run
        self._poll_node()
        if self.set_up and state is SessionState.READY:
            self._update_first_goal()
        if run is not None:
            self.record_activity()
            return self._node_silence(run, state)
        if self.armed and now - self._touched > IDLE_S:
            self.disarm(_NOBODY_DID_ANYTHING(minutes=IDLE_S / 60))
        if self.armed and (problem := self.leader_problem):
            self.disarm(problem)
            self._event("leader_lost", problem)
        return None

    def _update_first_goal(self) -> None:
        """Give the set-up the pose to which the robot must move before it follows the leader.

        The pose changes as the leader moves.
        """
        relay = self._relay
        if relay is not None:
            qpos = np.array(self._shared_state.observation.read()["qpos"], np.float64)
            status = self._shared_state.control.read()
            commanded = np.array(status["commanded"], np.float64) if status["engaged"] else None
            self._setup.set_first_action(relay.first_goal(qpos, commanded))

    # --- reports of the node -----------------------------------------------------------------------------------

    def _poll_node(self) -> None:
        if not self._node_leads:
            return
        record = self._shared_state.observation.read()
        at = float(record["joints_captured"])
        if record["has"][3] and at != self._reported_at:  # reported_action
            self._reported_at = at
            self._reported = [*self._reported[-39:], at]

    def _node_silence(self, run: Run, state: SessionState) -> tuple[SessionEvent, str] | None:
        """Return an event if a node that should drive the robot reports no action, else None."""
        if not self._node_leads or run.begun_at is None or state is not SessionState.RUNNING:
            return None
        since = max(self._reported_at or -math.inf, run.followed_at)
        silent = self._clock.now() - since
        if silent <= NODE_SILENT_S:
            return None
        never = self._reported_at is None or self._reported_at < run.begun_at
        reason = _NODE_NEVER_REPORTED(seconds=NODE_SILENT_S) if never else _NODE_SILENT(seconds=silent)
        self._event("node_silent", reason)
        return (SessionEvent.RUN_FAILED if never else SessionEvent.HELD), reason

    # --- episodes --------------------------------------------------------------------------------------------

    def manifest(self, asked: RunRequest) -> dict[str, Any]:
        """Return the manifest fields of a demonstration that differ from those of a run with a policy."""
        assert self._settings is not None
        info = self._setup.info
        return {
            "kind": "demonstration",
            "session": asked.session.model_dump() if asked.session else {},
            "collection": self._settings.manifest_entry(self._plan.cameras),
            "policy": {"kind": "teleop", "name": info.name if info else ""},
            **({} if asked.task is None else {"task": asked.task}),
        }

    def on_episode_started(self, episode: str, asked: RunRequest) -> None:
        """Record that an episode was requested."""
        self.task = asked.task or ""
        if episode:
            self._asked.append(episode)

    def on_open_failed(self) -> None:
        """Remove the open run's episode, because its recording could not be opened."""
        if self.run is not None and self.run.uuid in self._asked:
            self._asked.remove(self.run.uuid)

    def on_episode_closed(self, message: EpisodeClosed) -> None:
        """Record that an episode is on disk, and emit an event if it is too short."""
        if self._settings is None or message.uuid not in self._asked or message.waits:
            return
        label = latest_label(self._data, message.uuid)
        self.last = {
            "uuid": message.uuid,
            "rows": message.rows,
            "result": label.result if label else None,
            "discarded": label.discarded if label else False,
        }
        seconds = message.rows / self._plan.fps
        if seconds < self._settings.min_length_s:
            text = _SHORT(episode=message.uuid, seconds=seconds, least=self._settings.min_length_s)
            self._event("episode_short", text)

    def label(self, asked: LabelRequest, by: str) -> Mapping[str, Any]:
        """Write a label with the result of an episode; return the label."""
        episode, before = self._find_episode(asked.episode)
        return self._write(
            episode, replace(before, time=time.time(), by=by, result=asked.result, note=asked.note)
        )

    def discard(self, asked: DiscardRequest, by: str) -> Mapping[str, Any]:
        """Mark an episode as never to be published, without deleting its files; return the label."""
        episode, before = self._find_episode(asked.episode)
        return self._write(episode, replace(before, time=time.time(), by=by, discarded=True))

    def _write(self, episode: str, label: Label) -> Mapping[str, Any]:
        append_label(self._data, episode, label)
        if self.last is not None and self.last["uuid"] == episode:
            self.last |= {"result": label.result, "discarded": label.discarded}
        data = {
            "episode": episode,
            "result": label.result,
            "note": label.note,
            "discarded": label.discarded,
            "by": label.by,
        }
        how = "discarded" if label.discarded else str(label.result)
        self._say(Event("labelled", _LABELLED(episode=episode, how=how), self._clock.now(), data=data))
        return data

    def _find_episode(self, requested: str | None) -> tuple[str, Label]:
        """Return the uuid of the episode `requested` (None: the open or the newest one), and its latest label.

        Raises:
            RuntimeFault: the episode is no demonstration of this station, or `requested` names the open episode.
        """
        run = self.run
        if requested is None:
            episode = run.uuid if run is not None else self._newest
            if run is None and self._opened() is not None:
                raise RuntimeFault(_OPEN_RUN_NO_DEMONSTRATION)
            if not episode:
                raise RuntimeFault(_NONE_COLLECTED)
        else:
            episode = requested
            if run is not None and run.uuid == requested:
                raise RuntimeFault(_EPISODE_OPEN(episode=requested))
            if requested not in self._asked:
                self._require_demonstration(requested)
        before = latest_label(self._data, episode)
        return episode, before or Label(0.0, "")

    def _require_demonstration(self, episode: str) -> None:
        latest_label(self._data, episode)  # raises if it is no uuid, before it becomes part of a path
        path = self._plan.deployment.episodes_dir / episode / "manifest.json"
        try:
            kind = json.loads(path.read_text("utf-8")).get("kind")
        except (OSError, ValueError, AttributeError) as error:
            raise RuntimeFault(_NO_SUCH_EPISODE(episode=episode, error=error)) from None
        if kind != "demonstration":
            raise RuntimeFault(_NO_DEMONSTRATION(episode=episode, kind=kind))

    # --- for pages -------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any] | None:
        """Return the status for the snapshot; None if the deployment configures no collection."""
        if self._settings is None:
            return None
        settings, run, cameras = self._settings, self.run, self._plan.cameras
        described = settings.manifest_entry(cameras)
        return {
            "source": settings.source,
            "mode": settings.mode,
            "set_up": self.set_up,
            "armed": self.armed,
            "why_not": self.why_not,
            "leader": self._leader(),
            "task": self.task or self._inference.requests.task,
            "episode": run.uuid if run is not None else None,
            "last": self.last,
            "dataset": settings.dataset,
            "cameras": described["cameras"],
            "primary_camera": described["primary_camera"],
            "min_length_s": settings.min_length_s,
            "setup": self._fingerprint(),
        }

    def _fingerprint(self) -> dict[str, Any] | None:
        """Return the robot, cameras, rate and streams that the next episode will record.

        The keys are those of the manifest. If a camera has sent no picture yet, return the previous result, None if
        there is none.
        """
        assert self._settings is not None
        record, robot = self._shared_state.observation.read(), self._plan.robot
        described = self._settings.manifest_entry(self._plan.cameras)
        cameras = {}
        for key in described["cameras"]:
            number = int(record["picture_number"][self._shared_state.layout.cameras.index(key)])
            size = self._shared_state.pictures[key].shape(number) if number else None
            if size is None:
                return self._seen
            cameras[key] = {"width": size[1], "height": size[0]}
        schema = Schema.from_manifest({"collection": described})
        self._seen = {
            "robot": robot.name,
            "groups": [group.name for group in robot.groups],
            "joints": list(robot.joint_names),
            "cameras": cameras,
            "fps": self._plan.fps,
            "streams": schema.streams(
                qvel=bool(record["has"][0]), effort=bool(record["has"][1]), posed=bool(robot.eef_dim)
            ),
        }
        return self._seen

    def _leader(self) -> dict[str, Any]:
        assert self._settings is not None
        now, relay = self._clock.now(), self._relay
        if self._node_leads:
            return self._node(now)
        kind = "" if self._settings.leader is None else self._settings.leader.kind
        newest_pose = None if relay is None else relay.leader.latest_pose
        if relay is None or newest_pose is None:
            return {"kind": kind, "rate": 0.0, "age_s": None, "state": "absent"}
        state = "silent" if relay.leader_problem() else "alive"
        return {
            "kind": kind,
            "rate": relay.leader.rate,
            "age_s": now - newest_pose.arrived,
            "state": state,
        }

    def _node(self, now: float) -> dict[str, Any]:
        at, run = self._reported_at, self.run
        age = None if at is None else now - at
        alive = age is not None and age <= NODE_SILENT_S
        times = self._reported
        rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9) if alive and len(times) > 1 else 0.0
        begun = run is not None and run.begun_at is not None
        state = "alive" if alive else "silent" if begun else "unknown"
        return {"kind": "node", "rate": rate, "age_s": age, "state": state}

    def _event(self, kind: str, text: str) -> None:
        self._say(Event(kind, text, self._clock.now()))
