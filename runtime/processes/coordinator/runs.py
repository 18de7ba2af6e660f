"""Runs and recordings in the coordinator: open, hold, resume and close them, and notify media."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from runtime.core.clock import Clock
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import ControlSource, Float64
from runtime.ipc.command_arguments import RunRequest
from runtime.ipc.messages import (
    BeginEpisode,
    EndEpisode,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    Message,
    encode,
)
from runtime.ipc.shared_state import SharedState
from runtime.policies.base import PolicyInfo
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.session.transitions import STOPPED
from runtime.recording.files import require_room
from runtime.station.run import Provenance, Run
from runtime.station.spec import StationSpec

log = logging.getLogger(__name__)
_RECORDING_ALONE_OPEN = fixed(
    "runs.recording_alone_open",
    "a recording without a run is open: record stop first",
)
_NONE_OPEN = fixed("runs.none_open", "no run is open: stop, then run")
_RECORDING_ENDED = Pattern(
    "runs.recording_ended",
    "the recording of this run has ended ({why}): stop, then run",
)
_RECORDING_OPEN = fixed("runs.recording_open", "a recording is open already")
_NO_RECORDING_ALONE = fixed(
    "runs.no_recording_alone",
    "no recording is open; a run's own recording ends with the run",
)
_EPISODE_CLOSED = Pattern("runs.episode_closed", "episode {episode} {how}, {rows} rows: {reason}")
_EPISODE_WAITS = Pattern(
    "runs.episode_waits",
    "episode {episode} waits for room on the disk, {rows} rows: {reason}",
)
_MEDIA_DOES_NOT_READ = fixed(
    "runs.media_does_not_read",
    "media does not read: the ring is full; restart the station",
)


class Runs:
    """Runs of a station: at most one open run, or one standalone recording."""

    def __init__(
        self,
        spec: StationSpec,
        shared: SharedState,
        clock: Clock,
        inference: Inference,
        orders: ControlQueue,
        provenance: Provenance,
        figures: Callable[[], dict[str, Any]],
        prepared: Callable[[], bool],
    ) -> None:
        self._plan = spec
        self._shared_state = shared
        self._clock = clock
        self._inference = inference
        self._orders = orders
        self._provenance = provenance  # of the next manifest
        self._figures = figures  # of control, for the outcome
        self._prepared = prepared  # starts to load kinematics for jogs; whether they are loaded
        self.open: Run | None = None
        self._count = int(shared.control.read()["run"])
        self._generation = shared.generation("coordinator")
        self._alone = ""  # uuid of a standalone recording
        self.last: dict[str, Any] = {}  # how the last run ended
        self.last_episode: dict[str, Any] = {}

    @property
    def _requires_recording(self) -> bool:
        """Whether the deployment forbids a run to continue without its recording."""
        return self._plan.deployment.recording.on_failure == "hold"

    def _must_record(self, trial: bool, mode: str) -> bool:
        """Return True if a run must not begin without its recording, for example a trial or a demonstration."""
        return self._requires_recording or trial or mode == "collect"

    def _require_room(self) -> None:
        """Raise RecordingError if the episodes' disk has too little room for another episode."""
        settings = self._plan.deployment
        require_room(settings.episodes_dir, settings.recording.min_free_bytes)

    def status(self, now: float) -> dict[str, Any]:
        """Return the open run, the results of the last run and episode, and the checkpoint."""
        none = {"number": 0, "uuid": "", "elapsed": 0.0, "held": 0.0, "duration_s": None}
        return {
            "checkpoint": dict(self._provenance.checkpoint),
            "run": self.open.status(now) if self.open else none,
            "last_run": self.last,
            "episode": self.last_episode,
        }

    @property
    def provenance(self) -> Provenance:
        """What the manifest of the next episode says about the station, as of the last set-up."""
        return self._provenance

    def update_provenance(self, **changes: Any) -> None:
        """Change fields of Provenance (specification, checkpoint, bench) for the manifests of later episodes."""
        self._provenance = replace(self._provenance, **changes)

    # --- runs ----------------------------------------------------------------------------------------------

    def begin(
        self,
        info: PolicyInfo | None,
        asked: RunRequest,
        more: Mapping[str, Any] = MappingProxyType({}),
        command: str = "",
    ) -> str:
        """Request an episode from media; return its uuid, "" without a recording.

        The run begins when the episode is open. `more` overrides fields of the manifest, `command` is the uuid of the
        command that starts the run.

        Raises:
            RuntimeFault: a standalone recording is open, or the disk has no room for a required recording.
        """
        if self._alone:
            raise RuntimeFault(_RECORDING_ALONE_OPEN)
        settings = self._plan.deployment
        mode = asked.mode or settings.run.mode
        if settings.recording.enabled and self._must_record(asked.trial is not None, mode):
            self._require_room()
        self._count += 1
        limit = settings.run.duration_s if asked.duration_s is None else asked.duration_s
        sim_state = asked.sim_state or settings.run.sim_state
        manifest = None
        if settings.recording.enabled:
            manifest = self._provenance.manifest(mode, info, sim_state)
            manifest |= {"trial": asked.trial or {}, "duration_s": limit}
            manifest |= (
                {"kind": "demonstration"} if mode != "manual" and self._inference.policy.is_person else {}
            )
            manifest |= {} if asked.operator is None else {"operator": asked.operator}
            manifest |= more
        identity = str(manifest["uuid"]) if manifest else str(uuid.uuid4())
        self._send(BeginEpisode(self._count, manifest, self._generation))
        self._inference.use_simulated(mode == "sim" and sim_state == "simulated")
        self.open = Run(
            self._count,
            identity,
            self._clock.now(),
            limit,
            mode,
            asked.trial is not None,
            command=command,
            counted=self._figures(),
        )
        return identity if manifest else ""

    def on_episode_opened(self, message: EpisodeOpened, running: bool) -> str:
        """Begin the run after its episode was opened, or after opening failed and the run need not be recorded.

        The robot is started only if the session is `running`. If the run cannot begin, the method returns the reason:
        an error of the recorder, or a doubt about the joints that arose after the run was accepted. Otherwise it
        returns "".
        """
        if message.error and message.run == 0:
            self._alone = ""
        run = self.open
        if run is None or message.run != run.number or run.begun_at is not None:
            return ""
        if message.error and self._must_record(run.trial, run.mode):
            run.fail_to_open()
            return message.error
        if message.error:
            run.stop_recording(message.error)
            self._send(BeginEpisode(run.number, None, self._generation))  # the source plays all the same
            return ""
        run.open()
        doubt = self._shared_state.joint_problem if running and self._plan.capabilities.moves_robot else ""
        if running and not doubt:
            self._start(run)
        return doubt  # it arose after the run was accepted

    def hold(self, reason: str) -> None:
        """Brake, hold, stop querying; the clock of an open run pauses."""
        self._inference.pause()
        self._orders.send_order("hold", run=self._begun, reason=reason)
        if self.open:
            self.open.hold(self._clock.now())

    @property
    def _begun(self) -> int:
        """Number of the open run for orders; 0 if there is none, or it has not begun."""
        return 0 if self.open is None or self.open.begun_at is None else self.open.number

    def resume(self) -> None:
        """Resume the open run.

        Raises:
            RuntimeFault: no run is open, or its required recording has ended.
        """
        run = self.open
        if run is None:
            raise RuntimeFault(_NONE_OPEN)
        if run.unrecorded and self._requires_recording:
            raise RuntimeFault(_RECORDING_ENDED(why=run.unrecorded))
        if run.begun_at is not None:
            run.resume(self._clock.now())
            self._follow(run, fresh=False)
        elif run.opened:  # it was halted before it began
            self._start(run)

    def end(self, status: str, reason: str) -> None:
        """Brake, hold, close the open run."""
        self._inference.pause()
        self._inference.use_simulated(False)
        self._orders.send_order("hold", reason=reason)
        run, self.open = self.open, None
        if run is not None:
            if run.begun_at is not None and run.mode not in ("manual", "collect"):
                self._inference.requests.end_episode()
            seconds = run.elapsed(self._clock.now())
            self.last = {"number": run.number, "uuid": run.uuid, "status": status, "reason": reason}
            policy = self._inference.metrics.figures()
            details = {"run_seconds": seconds, "control": run.figures(self._figures()), "policy": policy}
            details |= {"reached": run.reached} if run.reached else {}
            self.record_event(EndEpisode(status, reason, details))  # a stop must not fail because media hangs

    def update_truth(self, truth: Mapping[str, Any], running: bool) -> None:
        """Record the time at which a simulated bench first reports each milestone as reached.

        Nothing is recorded unless a run is `running`.
        """
        run, milestones = self.open, truth.get("milestones")
        if not running or run is None or run.begun_at is None or not isinstance(milestones, Mapping):
            return
        for name, reached in milestones.items():
            if reached:
                run.reached.setdefault(str(name), round(run.elapsed(self._clock.now()), 2))

    def poll(self) -> None:
        """Begin a run that waits for kinematics as soon as they are loaded."""
        if self.open is not None and self.open.waiting:
            self._start(self.open)

    def _start(self, run: Run) -> None:
        """Begin a run; a manual run waits until jogs can be answered at once."""
        if run.mode == "manual" and not self._prepared():
            run.wait()
            return
        run.begin(self._clock.now())
        self._follow(run, fresh=True)

    def _follow(self, run: Run, fresh: bool) -> None:
        run.arrive()
        if run.mode == "manual":
            self._orders.send_order("hold", run=run.number)
        elif run.mode == "collect" and not self._inference.policy.is_queried:
            self._orders.send_order("yield", run=run.number, mode=run.mode)
        else:
            self._send_follow(run)
            self._inference.begin(run.number, fresh, run.mode)
            if run.mode == "collect":  # a leader has moved while the robot was held: it is engaged anew
                self._inference.requests.reset_episode()

    # --- motions within a run --------------------------------------------------------------------------------

    def move(self, goal: Float64, speed: float) -> None:
        """Order control to move the robot to `goal` [D] on a limited path, a generated motion.

        The motion belongs to the open run, if there is one. `speed` is the share of the speed of generated motions.
        """
        self._orders.send_order("motion", run=self._begun, goal=goal, speed=speed)

    def cancel(self) -> None:
        """Discard plan or motion, and stop; the run continues."""
        if self.open is not None:
            self._inference.cancel()
            self._start_after_arrival(self.open)

    def approach(self, goal: Float64) -> None:
        """Move the robot to `goal` [D], the joints at which the proposed chunk starts."""
        if self.open is not None:
            self.open.approach()
            self.move(goal, 1.0)

    def on_motion_done(self) -> None:
        """End an approach of the open run, because control has finished the motion."""
        if self.open is not None and self.open.is_approaching:
            self._start_after_arrival(self.open)

    def _start_after_arrival(self, run: Run) -> None:
        run.arrive()
        if run.mode == "manual":
            self._orders.send_order("hold", run=run.number)
        else:
            self._send_follow(run)

    def _send_follow(self, run: Run) -> None:
        source: ControlSource = "teleop" if self._inference.policy.is_person else "policy"
        self._orders.send_order("follow", run=run.number, mode=run.mode, source=source)

    # --- recordings ----------------------------------------------------------------------------------------

    @property
    def is_recording_standalone(self) -> bool:
        """Whether a standalone recording is open."""
        return bool(self._alone)

    def start_standalone_recording(self, info: PolicyInfo | None) -> str:
        """Open an episode that records everything that control does; return its uuid.

        Raises:
            RuntimeFault: a standalone recording is open already.
            RecordingError: the disk has no room.
        """
        if self._alone:
            raise RuntimeFault(_RECORDING_OPEN)
        self._require_room()
        manifest = self._provenance.manifest("observe", info)
        self._send(BeginEpisode(0, manifest, self._generation))
        self._alone = str(manifest["uuid"])
        return self._alone

    def stop_standalone_recording(self) -> None:
        """Close the standalone recording.

        Raises:
            RuntimeFault: no standalone recording is open.
        """
        if not self._alone:
            raise RuntimeFault(_NO_RECORDING_ALONE)
        self._send(self._end_alone("finished", STOPPED))
        self._alone = ""

    def _end_alone(self, status: str, reason: str) -> EndEpisode:
        return EndEpisode(status, reason, {"control": self._figures()})

    def interrupt_standalone_recording(self, reason: str) -> None:
        """Close a standalone recording as interrupted, if one is open.

        This also works if media hangs: the message to media is then lost, which is logged.
        """
        if self._alone:
            self.record_event(self._end_alone("interrupted", reason))
            self._alone = ""

    def on_process_restarted(self, process: str, reason: str) -> None:
        """End a standalone recording if media or control was restarted.

        Its files were open in media, and control produced the ticks that it records.
        """
        if process == "media":
            self._alone = ""  # repair closes it
        elif process == "control":
            self.interrupt_standalone_recording(reason)

    def on_episode_closed(self, message: EpisodeClosed) -> Event:
        """Record that an episode is closed, or waits for room on the disk; return the event about it."""
        if self.open is not None and self.open.uuid == message.uuid:
            self.open.stop_recording(message.error or message.reason)
        if self._alone == message.uuid:
            self._alone = ""
        self.last_episode = {
            "uuid": message.uuid,
            "path": message.path,
            "status": message.status,
            "reason": message.reason,
            "rows": message.rows,
            "error": message.error,
            "waits": message.waits,
        }
        fields = {"episode": message.uuid, "rows": message.rows, "reason": message.reason}
        text = _EPISODE_WAITS(**fields) if message.waits else _EPISODE_CLOSED(**fields, how=message.status)
        return Event("episode_closed", text, self._clock.now(), data=self.last_episode)

    def record_event(self, message: Message) -> None:
        """Send a message to media for the record.

        If media does not read the message, the message is lost, and the loss is logged.
        """
        try:
            self._send(message)
        except RuntimeFault as error:
            log.error("%s is missing from the record: %s", type(message).__name__, error)

    def _send(self, message: Message) -> None:
        if not self._shared_state.rings["minutes"].push(encode(message)):
            raise RuntimeFault(_MEDIA_DOES_NOT_READ)
