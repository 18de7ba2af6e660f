"""The process that decides: commands, session, set-up, inference, events; it never touches 30 Hz pictures."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable
from typing import Any

import zmq

from runtime.bus import STREAM_HIGH_WATER, CommandServer, Endpoints, EventLog, Publisher
from runtime.clock import Clock, MonotonicClock
from runtime.command_journal import CommandJournal
from runtime.errors import RuntimeFault
from runtime.family import Plan, join
from runtime.inference import Inference, InferenceSettings, Runner, ThreadRunner
from runtime.latch import Latch
from runtime.lease import Lease
from runtime.messages import (
    Ack,
    BeginEpisode,
    ChunkMerged,
    Command,
    EndEpisode,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    MediaReport,
    Message,
    decode,
    encode,
)
from runtime.orders import Orders
from runtime.page import EStop, Page
from runtime.run import Provenance, Run
from runtime.session import LEASE_COMMANDS, Effects, Happening, Session, State
from runtime.setup import SetUp
from runtime.snapshot import snapshot

log = logging.getLogger(__name__)
_LINK_LOST_S = 2.0
_CONNECTED_S = 1.0
_SIBLINGS = ("control", "media", "guard")
# Control's own reasons to hold, as events of these kinds.
_HOLDS = ("refusals", "starvation", "unmeasured", "family", "orphaned")


class Main(Effects):
    """One `pump` does everything that is due; lockstep calls it tick by tick."""

    def __init__(self, plan: Plan, page: Page, clock: Clock, runner: Runner) -> None:
        self.plan, self.page, self.clock = plan, page, clock
        self.boot = str(uuid.uuid4())
        settings = plan.deployment
        self.events = EventLog()
        self.lease = Lease(settings.lease.ttl_s)
        self.session = Session(self, self.lease, self.boot, clock.now)
        self._orders = Orders(page)
        policy = plan.policy.build(settings.policy, plan.robot, clock, plan.rate)
        query = plan.strategy.query(settings.strategy)
        self.inference = Inference(
            policy, query, plan.spaces(), page, self._orders, runner, clock, _inference_settings(plan)
        )
        self.setup = SetUp(plan, self.inference, self._orders, page, clock)
        self._provenance = Provenance(plan, self.boot)
        self.run: Run | None = None
        self._runs = int(page.control.read()["run"])
        self.last_episode: dict[str, Any] = {}
        self.media_report = MediaReport(0.0, {}, {}, 0, "", 0)
        self.estop_sentence = ""
        self._recording_alone = False
        self._generations = {name: page.generation(name) for name in _SIBLINGS}
        self._lease_held = False
        for ring in ("control_events", "media_events"):
            for _ in page.rings[ring].drain():
                pass  # told to a predecessor that died

    def pump(self) -> None:
        """Hear the family, check what may have ended, advance set-up and inference."""
        self.page.beat("main", self.clock.now())
        for ring in ("control_events", "media_events"):
            for payload in self.page.rings[ring].drain():
                self._hear(decode(payload))
        self._check_family()
        self._check_estop()
        self._check_lease()
        self._check_link()
        self._advance_setup()
        self._check_run()
        self._advance_inference()

    # --- effects: what the session makes happen ------------------------------------------------------------

    def begin_setup(self) -> None:
        self.setup.begin()

    def cancel_setup(self, reason: str) -> None:
        self.setup.cancel()
        self._orders.give("hold", reason=reason)

    def begin_run(self) -> None:
        if self._recording_alone:
            raise RuntimeFault("a recording without a run is open: record stop first")
        self._require_family()
        self._runs += 1
        manifest = None
        if self.plan.deployment.recording.enabled:
            manifest = self._provenance.manifest(self.plan.deployment.run.mode, self.setup.info)
        identity = str(manifest["uuid"]) if manifest else str(uuid.uuid4())
        self.run = Run(self._runs, identity, self.clock.now())
        self._tell_media(BeginEpisode(self._runs, manifest))

    def hold(self, reason: str) -> None:
        self.inference.pause()
        self._orders.give("hold", run=self.run.number if self.run else 0, reason=reason)
        if self.run:
            self.run.hold(self.clock.now())

    def resume_run(self) -> None:
        if self.run is None:
            raise RuntimeFault("no run is open: stop, then run")
        if self.run.unrecorded and self.plan.deployment.recording.on_failure == "hold":
            raise RuntimeFault(f"the recording of this run has ended ({self.run.unrecorded}): stop, then run")
        if self.run.begun is not None:
            self.run.resume(self.clock.now())
            self._follow(self.run, fresh=False)
        elif self.run.opened:  # it was halted before it began
            self._begin(self.run)

    def end_run(self, status: str, reason: str) -> None:
        self.inference.pause()
        self._orders.give("hold", reason=reason)
        run, self.run = self.run, None
        if run is not None:
            now = self.clock.now()
            details = {"run_seconds": run.elapsed(now), "control": self._control_figures()}
            self._tell_media(EndEpisode(status, reason, details))
        if self._recording_alone and status != "finished":
            self._end_recording(status, reason)

    def go_home(self) -> None:
        if not self.plan.capabilities.moves_robot:
            raise RuntimeFault(f"transport {self.plan.deployment.transport.kind!r} moves no robot")
        self.setup.begin_homing()

    def release_estop(self) -> None:
        self.page.ask_release()

    def start_recording(self) -> None:
        if self._recording_alone:
            raise RuntimeFault("a recording is open already")
        self._require_family()
        self._recording_alone = True
        self._tell_media(BeginEpisode(0, self._provenance.manifest("observe", self.setup.info)))

    def stop_recording(self) -> None:
        if not self._recording_alone:
            raise RuntimeFault("no recording is open; a run's own recording ends with the run")
        self._end_recording("finished", "stopped by the operator")

    def _require_family(self) -> None:
        """What is sent to a process that is still starting would be lost."""
        now, within = self.clock.now(), self.plan.deployment.control.heartbeat_timeout_s
        for name in _SIBLINGS:
            if not self.page.alive(name, now, within):
                raise RuntimeFault(f"the process {name} gives no sign of life yet: try again in a moment")

    def _end_recording(self, status: str, reason: str) -> None:
        self._recording_alone = False
        self._tell_media(EndEpisode(status, reason, {"control": self._control_figures()}))

    def _begin(self, run: Run) -> None:
        run.begin(self.clock.now())
        self._follow(run, fresh=True)

    def _follow(self, run: Run, fresh: bool) -> None:
        self._orders.give("follow", run=run.number)
        self.inference.begin(run.number, fresh)

    # --- what the family says ------------------------------------------------------------------------------

    def _hear(self, message: Message) -> None:
        if isinstance(message, Event):
            self._hear_event(message)
        elif isinstance(message, ChunkMerged):
            self.inference.merged(message)
            if message.dropped:
                text = f"chunk {message.chunk_id} dropped: {message.dropped}"
                self.say(Event("chunk_dropped", text, self.clock.now(), message.arrival_step))
        elif isinstance(message, EpisodeOpened):
            self._episode_opened(message)
        elif isinstance(message, EpisodeClosed):
            self._episode_closed(message)
        elif isinstance(message, MediaReport):
            self.media_report = message

    def _hear_event(self, event: Event) -> None:
        self._log(event)  # control writes its own events into the episode
        self.setup.heard(event)
        evidence = self.plan.deployment.recording.on_failure == "hold"
        if event.kind in _HOLDS or (event.kind == "recording_failed" and evidence):
            self._observe(Happening.HELD, event.text)

    def _episode_opened(self, opened: EpisodeOpened) -> None:
        if opened.error:
            self.say(Event("recording_failed", opened.error, self.clock.now()))
            if opened.run == 0:
                self._recording_alone = False
        elif opened.uuid:
            self.say(Event("episode_opened", f"recording {opened.uuid}", self.clock.now()))
        run = self.run
        if run is None or opened.run != run.number or run.begun is not None:
            return
        if opened.error and self.plan.deployment.recording.on_failure == "hold":
            self._observe(Happening.RUN_FAILED, opened.error)
        elif opened.error:
            self._tell_media(BeginEpisode(run.number, None))  # unrecorded; the source plays all the same
        else:
            run.opened = True
            if self.session.state is State.RUNNING:
                self._begin(run)

    def _episode_closed(self, closed: EpisodeClosed) -> None:
        if self.run is not None and self.run.uuid == closed.uuid:
            self.run.unrecorded = closed.error or closed.reason
        self.last_episode = {
            "uuid": closed.uuid,
            "path": closed.path,
            "status": closed.status,
            "reason": closed.reason,
            "rows": closed.rows,
            "error": closed.error,
        }
        text = f"episode {closed.uuid} {closed.status}, {closed.rows} rows: {closed.reason}"
        self.say(Event("episode_closed", text, self.clock.now(), data=self.last_episode))

    def _tell_media(self, message: Message) -> None:
        if not self.page.rings["minutes"].push(encode(message)):
            raise RuntimeFault("media does not read: the ring is full; restart the station")

    def say(self, event: Event) -> None:
        """An event of main's own: to the log, to clients, into the episode."""
        self._log(event)
        self._tell_media(event)

    def _log(self, event: Event) -> None:
        self.events.append(event)
        log.info("%s: %s", event.kind, event.text)

    def _observe(self, happening: Happening, reason: str) -> None:
        before = self.session.state
        if self.session.observe(happening, reason):
            text = f"{before} -> {self.session.state}: {reason}"
            self.say(Event("state", text, self.clock.now(), data={"state": str(self.session.state)}))

    # --- what may have ended -------------------------------------------------------------------------------

    def _check_family(self) -> None:
        for name in _SIBLINGS:
            generation = self.page.generation(name)
            if generation != self._generations[name]:
                self._generations[name] = generation
                reason = f"the process {name} died and was restarted: set up again"
                self.say(Event("family_died", reason, self.clock.now(), data={"process": name}))
                if name == "media":
                    self._recording_alone = False
                self._observe(Happening.FAMILY_DIED, reason)

    def _check_estop(self) -> None:
        latched = self.page.estop is EStop.LATCHED
        if latched and self.session.state is not State.FAULTED:
            pressed = Latch(self.plan.deployment.station_dir).read()
            self.estop_sentence = f"by {pressed.by}: {pressed.why}" if pressed else "pressed"
            self._observe(Happening.ESTOPPED, f"e-stop {self.estop_sentence}: make safe, then release")
        elif not latched and self.session.state is State.FAULTED:
            self.estop_sentence = ""
            self._observe(Happening.RELEASED, "e-stop released: set up again")

    def _check_lease(self) -> None:
        held = self.lease.current(self.clock.now())
        if held is None and self._lease_held:
            self._observe(Happening.LEASE_ENDED, "the lease was not renewed: claim it, then resume or stop")
        self._lease_held = held is not None

    def _check_link(self) -> None:
        record = self.page.observation.read()
        if not record["sequence"]:
            return
        age = self.clock.now() - float(record["arrived"])
        if age < _CONNECTED_S and (record["picture_number"][: len(self.page.layout.cameras)] > 0).all():
            self._observe(Happening.CONNECTED, "observations arrive: set up")
        elif age > _LINK_LOST_S and not record["last"]:
            self._observe(
                Happening.LINK_LOST, f"no observation for {age:.1f} s: is the execution node running?"
            )

    def _check_run(self) -> None:
        run = self.run
        if run is None or run.begun is None or self.session.state is not State.RUNNING:
            return
        duration = self.plan.deployment.run.duration_s
        if duration is not None and run.elapsed(self.clock.now()) >= duration:
            self._observe(Happening.RUN_ENDED, f"the run's {duration:g} s are over")
            return
        record = self.page.observation.read()
        if record["last"] and int(self.page.control.read()["sequence"]) == int(record["sequence"]):
            self._observe(Happening.RUN_ENDED, "the recording that is the source has ended")

    def _advance_setup(self) -> None:
        if not self.setup.active:
            return
        stage = self.setup.stage
        try:
            done = self.setup.pump()
        except RuntimeFault as error:
            self.setup.cancel()
            self._orders.give("hold")
            self._observe(Happening.SETUP_FAILED, str(error))
            return
        if self.setup.stage is not stage:
            self.say(Event("setup", str(self.setup.stage), self.clock.now()))
        if done:
            self._observe(Happening.SETUP_DONE, self.setup.outcome)

    def _advance_inference(self) -> None:
        try:
            answer = self.inference.pump()
        except RuntimeFault as error:
            self.say(Event("policy_failed", str(error), self.clock.now()))
            self._observe(Happening.HELD, str(error))
            return
        if answer is not None:
            self._tell_media(answer)
        for note in self.inference.notes:
            self.say(note)
        self.inference.notes.clear()

    def _control_figures(self) -> dict[str, Any]:
        figures: dict[str, Any] = snapshot(self)["control"]
        return figures

    # --- commands ------------------------------------------------------------------------------------------

    def handle(self, command: Command) -> Ack:
        """The answer to a command or a query of a client."""
        if command.kind == "status":
            return Ack(
                command.uuid, "done", boot=self.boot, sequence=self.session.sequence, data=snapshot(self)
            )
        if command.kind == "events_since":
            rows = self.events.since(int(command.args.get("number", 0)))
            return Ack(command.uuid, "done", boot=self.boot, data={"events": rows})
        before, sequence = self.session.state, self.session.sequence
        ack = self.session.handle(command)
        # A lease that is kept is a stream; only its changes and refusals are worth a line.
        kept = command.kind in LEASE_COMMANDS and ack.status == "accepted" and ack.sequence == sequence
        if not kept:
            who = command.user or command.holder
            what = f"{command.kind} by {who}: {ack.status}" + (f", {ack.reason}" if ack.reason else "")
            data = {"uuid": command.uuid, "from": str(before), "to": str(self.session.state)}
            self.say(Event("command", what, self.clock.now(), data=data))
        return ack

    def close(self) -> None:
        """Let go of the policy."""
        self.inference.policy.close()
        self.inference.runner.close()


def _inference_settings(plan: Plan) -> InferenceSettings:
    settings = plan.deployment
    return InferenceSettings(
        plan.rate,
        settings.task,
        settings.safety.joint_age_s,
        settings.safety.picture_age_s,
        plan.robot.binary_dims,
        settings.control.starvation_hold_s,
    )


class Bus:
    """Main's sockets: answers commands at once, publishes snapshots at 10 Hz and joints at 30."""

    def __init__(self, main: Main, context: zmq.Context[Any]) -> None:
        self._main = main
        settings = main.plan.deployment
        self._server = CommandServer(context, settings.bus.host, settings.bus.command_port)
        self._streams = Publisher(context, settings.bus.host, settings.bus.state_port, STREAM_HIGH_WATER)
        self._journal = CommandJournal(settings.station_dir)
        main.session.remember(self._journal.answers)
        endpoints = {"commands": self._server.endpoint, "state": self._streams.endpoint, "boot": main.boot}
        Endpoints(settings.station_dir).write("main", endpoints)
        self._due: dict[str, float] = {}
        self._told = 0

    def serve(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for a command; answer all there are; publish what is due."""
        self._server.socket.poll(int(timeout * 1000))
        while (received := self._server.receive()) is not None:
            address, command = received
            ack = self._main.handle(command)
            if command.kind not in ("status", "events_since", "lease_renew"):
                self._journal.append(command, ack)
            self._server.answer(address, ack)
        self._publish()

    def _publish(self) -> None:
        main, now = self._main, self._main.clock.now()
        self._every("state", 0.1, now, lambda: snapshot(main))
        self._every("joints", 1 / 30, now, self._joints)
        for event in main.events.since(self._told):
            self._streams.publish("event", event)
        self._told = main.events.newest

    def _every(self, stream: str, period: float, now: float, content: Callable[[], object]) -> None:
        if now >= self._due.get(stream, 0.0):
            self._due[stream] = now + period
            self._streams.publish(stream, content())

    def _joints(self) -> dict[str, Any]:
        status, seen = self._main.page.control.read(), self._main.page.observation.read()
        return {
            "step": int(status["step"]),
            "measured": seen["qpos"].copy(),
            "commanded": status["commanded"].copy(),
            "engaged": bool(status["engaged"]),
        }

    def close(self) -> None:
        self._server.close()
        self._streams.close()


def main() -> None:
    """Decide until the supervisor is gone."""
    member = join("main")
    runtime = Main(member.plan, member.page, MonotonicClock(), ThreadRunner())
    bus = Bus(runtime, zmq.Context.instance())
    while not member.lifeline.cut:
        runtime.pump()
        bus.serve(0.004)
    runtime.close()
    bus.close()


if __name__ == "__main__":
    main()
