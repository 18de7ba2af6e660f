"""A small lab in the database, and a runtime that says what a test tells it to say."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from django.contrib.auth.models import Group, User

from evaweb.episodes.models import Episode
from evaweb.stations.models import Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, FailureTerm, Milestone, Position, Scene, Trial
from runtime.ipc.messages import Ack, AckStatus, Command
from tests.standing import state_flags

BOOT = "boot-1"


def user(name: str, role: str = "operator") -> User:
    """An account of that role; everybody's password is the name."""
    made = User.objects.create_user(name, password=name)
    made.groups.set([Group.objects.get_or_create(name=role)[0]])
    return made


def scene(name: str = "block-on-plate", required: bool = True) -> Scene:
    """Two positions, three milestones of 1, 1 and 2 points, the last one required."""
    made = Scene.objects.create(
        name=name, title=name.replace("-", " "), instruction="put the block on the plate", time_limit_s=40
    )
    for number in (1, 2):
        bench = {"block": [0.1 * number, 0.3, 0], "plate": [-0.1, 0.3]}
        Position.objects.create(scene=made, number=number, bench=bench)
    for order, (text, points) in enumerate((("held", 1), ("lifted", 1), ("on the plate", 2)), start=1):
        Milestone.objects.create(
            scene=made, order=order, text=text, points=points, required=required and order == 3
        )
    return made


def failure_terms() -> None:
    """Two phases and two causes, with keys, and one of each that is retired; no others."""
    FailureTerm.objects.all().delete()
    for order, (level, words, key) in enumerate(
        (
            *(("phase", "approach", "a"), ("phase", "grasp", "g"), ("phase", "retired", "")),
            *(("cause", "missed", "m"), ("cause", "dropped", "d"), ("cause", "retired", "")),
        )
    ):
        FailureTerm.objects.create(level=level, words=words, key=key, order=order, active=words != "retired")


def finished_trial(trial: Trial, seconds: float | None = 12.5, **facts: Any) -> Trial:
    """The trial as a run leaves it that was recorded; `facts` are those of its episode."""
    row = {"station": trial.station, "status": "finished", "frames": 375, "duration_s": seconds, **facts}
    episode = Episode.objects.create(**row)
    Trial.objects.filter(pk=trial.pk).update(status="ended", duration_s=seconds, episode=episode)
    trial.refresh_from_db()
    return trial


@dataclass
class TrialBench:
    """A station, a scene, a checkpoint, an operator: what a trial is made of."""

    station: Station
    scene: Scene
    checkpoint: Checkpoint
    operator: User
    number: int = 0  # of the newest event

    def prepare(self, position: int = 1, **given: Any) -> Trial:
        """The next trial."""
        choice = {
            "user": self.operator,
            "station": self.station,
            "scene": self.scene,
            "position": self.scene.positions.get(number=position),
            "checkpoint": self.checkpoint,
        }
        return services.prepare_trial(**{**choice, **given})

    def ticks(self, *reached: bool) -> dict[object, bool]:
        """Milestone id -> reached, in their order."""
        return dict(zip(self.scene.milestones.values_list("pk", flat=True), reached, strict=True))

    def ended(self, position: int = 1, seconds: float = 12.5, **given: Any) -> Trial:
        """A trial whose run is over, without a station."""
        return finished_trial(self.prepare(position, **given), seconds)

    def scored(self, success: bool = True, **given: Any) -> Trial:
        """A trial that has its score."""
        trial = self.ended(**given)
        ticks = self.ticks(True, success, success)
        services.score_trial(user=self.operator, trial=trial, milestones=ticks)
        return trial

    def unrecorded(self, success: bool = True, seconds: float = 12.5) -> Trial:
        """A scored trial without a recording, as earlier versions took it."""
        trial = self.prepare()
        Trial.objects.filter(pk=trial.pk).update(status="ended", duration_s=seconds)
        trial.refresh_from_db()
        with patch.object(services, "why_unrecorded", return_value=""):
            ticks = self.ticks(True, success, success)
            services.score_trial(user=self.operator, trial=trial, milestones=ticks)
        return trial

    def event(self, kind: str, text: str = "", time: float = 0.0, **data: Any) -> Trial | None:
        """The station's next event, taken as the chronicle passes it on."""
        self.number += 1
        row = {"number": self.number, "kind": kind, "text": text, "time": time, "data": data}
        return services.apply_station_event(station=self.station, event=row, boot=BOOT)


def bench(station: str = "bench-1", operator: str = "ann") -> TrialBench:
    """A lab of one of each."""
    made = Station.objects.create(name=station, robot="agilex_piper", simulated=True, boot=BOOT)
    policy = {"url": "ws://127.0.0.1:8000"}
    checkpoint = Checkpoint.objects.create(name="pi0-block", policy=policy)
    return TrialBench(made, scene(), checkpoint, user(operator))


@dataclass
class FakeConnection:
    """Stands where the wire to a runtime stands; answers "accepted" unless told otherwise."""

    status_word: AckStatus = "accepted"
    reason: str = ""
    fault: Exception | None = None
    episode: uuid.UUID = field(default_factory=uuid.uuid4)
    heard: list[Command] = field(default_factory=list)
    snapshot: Mapping[str, Any] = field(default_factory=lambda: {**state_flags("ready"), "boot": BOOT})

    def request(self, command: Command, **how: Any) -> Ack:
        """The answer, or the fault."""
        self.heard.append(command)
        if self.fault is not None:
            raise self.fault
        data = {"episode": str(self.episode)} if command.kind == "run" else {}
        data = data if self.status_word == "accepted" else {}
        if command.kind == "setup" and self.status_word == "accepted":
            self.snapshot = {**self.snapshot, "checkpoint": command.args.get("checkpoint")}
        return Ack(command.uuid, self.status_word, self.reason, ["stop"], BOOT, 7, data)

    def request_urgent(self, command: Command, process: str, key: str, timeout: float) -> Ack:
        """The same, over a connection of its own."""
        return self.request(command)

    def status(self, timeout: float | None = None) -> Mapping[str, Any]:
        """The newest snapshot, or the fault."""
        if self.fault is not None:
            raise self.fault
        return self.snapshot
