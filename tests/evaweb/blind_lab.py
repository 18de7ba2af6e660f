"""A blind plan with recognisable secrets, and one trial of it through its stages.

The secrets are such that no clock, port or identifier has them by chance.
"""

from __future__ import annotations

import json
import re
import shutil
import uuid as uuids
from uuid import UUID

import numpy as np
from django.utils import timezone

from evaweb.episodes.exports import write_mcap
from evaweb.episodes.job_kinds import publish_episode
from evaweb.episodes.models import Episode
from evaweb.jobs.kinds import JobContext
from evaweb.jobs.models import Job
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan
from evaweb.preflights.models import Preflight
from evaweb.results.crates.imported import import_crate
from evaweb.results.models import Judgement
from evaweb.reviews.services import tags_change
from evaweb.stations.models import Command
from evaweb.trials import services as trials
from evaweb.trials.models import Checkpoint, Trial
from runtime.core.sentences import Pattern, within
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.recording.export import write_export
from tests.evaweb.results.crates.foreign_crates import foreign_crate
from tests.evaweb.trials import builders
from tests.runtime.recording.samples import resealed

NAMES = ("pi0-secret-alder", "pi0-secret-birch")
KEYS = (6606001, 6606002)  # in the database
FIGURE = 660606066060.6  # a latency [ms], recognisable also when it is rounded or shown in seconds
AIM = np.float32(31415.9)  # what the policy wants of a joint [rad]
ROWS = 57  # of a chunk
DIGEST = "c0ffee" * 10 + "beef"
LATENCY = "660606066"
SECRETS = (
    *("secret-alder", "secret-birch", "host-alder", "host-birch", ":64611", ":64622"),  # no ephemeral ports
    *("did not answer", f"{ROWS} rows", LATENCY, DIGEST, *map(str, KEYS)),
)
_SILENT = Pattern("test.blind.silent", "{url} did not answer within {seconds:g} s")
ERROR = _SILENT(url="ws://host-alder.example:64611", seconds=5)  # with arguments, which tell as much

# What follows from the checkpoint, and what stands there where it is of the other one; lengths differ where they may.
_THERE = {"alder": "birch", "birch": "alder", ":64611": ":64622", ":64622": ":64611"}
_THERE |= {str(KEYS[0]): str(KEYS[1]), str(KEYS[1]): str(KEYS[0])}
_THERE |= {str(FIGURE): "880808.8", str(FIGURE / 1e12): "0.25", LATENCY: "88080"}
_THERE |= {f"{ROWS} rows": "131 rows", DIGEST: "beef" + DIGEST[:-4]}
_HERE = re.compile("|".join(map(re.escape, sorted(_THERE, key=len, reverse=True))))


def in_the_other_world(text: str) -> str:
    """The text as it would be if the trial were of the other checkpoint; see tests.evaweb.two_worlds."""
    return _HERE.sub(lambda found: _THERE[found[0]], text)


class BlindLab:
    """One trial of a blind plan, stage by stage; `checkpoint` is the one that it is of."""

    def __init__(self, station, runtime, operator, folder, data):
        self.station, self.runtime, self.operator, self._folder, self.data = (
            station,
            runtime,
            operator,
            folder,
            data,
        )
        self.swapped = False  # see tests.evaweb.two_worlds
        self.owner = builders.user("olga")
        self.scene = builders.scene()
        policies = [
            {"url": f"ws://host-{name[-5:]}.example:646{n}{n}"} for n, name in enumerate(NAMES, start=1)
        ]
        rows = [
            Checkpoint.objects.create(pk=pk, name=name, policy=policy)
            for pk, name, policy in zip(KEYS, NAMES, policies, strict=True)
        ]
        draft = Plan.objects.create(
            name="blocks", title="Blocks", question=f"is {NAMES[0]} better?", owner=self.owner
        )
        draft.checkpoints.set(rows)
        draft.positions.set(self.scene.positions.all())
        self.plan = freeze_plan(user=self.owner, plan=draft)
        # Another lab has compared the same two: its rates would tell as much as ours.
        names = dict.fromkeys(NAMES, "")
        self.crate = import_crate(user=builders.user("ida", "admin"), file=foreign_crate(checkpoints=names))
        self.trial: Trial | None = None
        self.command: Command | None = None
        self.episode: Episode | None = None
        self.dataset = ""
        for row in rows:
            Preflight.objects.create(
                checkpoint=row,
                station=station,
                user=self.owner,
                by="station",
                policy=row.policy,
                status="done",
                report={"verdict": "ok", "url": row.policy["url"], "round_trip_ms": FIGURE},
            )

    def allocate(self):
        """The next trial; the station is being set up for it."""
        self.trial = trial = allocate_trial(user=self.operator, station=self.station, plan=self.plan).trial
        self.runtime.do(
            lambda: setattr(self.runtime, "snapshot", self._snapshot(type(self.runtime).snapshot))
        )
        self.command = Command.objects.create(
            uuid=uuids.uuid4(),
            station=self.station,
            kind="setup",
            user=self.operator,
            status="refused",
            reason=ERROR,
            args={
                "policy": trial.checkpoint.policy,
                "checkpoint": {"id": trial.checkpoint_id, "name": NAMES[0]},
            },
            data={"latency_ms": FIGURE, "name": NAMES[0]},
            issued_at=timezone.now(),
        )
        took = {"connect_s": FIGURE, "warm_up_s": FIGURE}
        Trial.objects.filter(pk=trial.pk).update(setup=self.command.pk, setup_took=took)
        self.runtime.emit("setup", "connecting to the policy")
        self.runtime.emit("setup_note", f"{NAMES[0]} answers {ROWS} rows in {FIGURE} ms")

    def _snapshot(self, plain):
        def told():
            assert self.trial is not None
            own = plain(self.runtime)
            said = own | {
                "checkpoint": {"id": self.trial.checkpoint_id, "name": self.trial.checkpoint.name},
                "validated": f"{ROWS} rows in {FIGURE} ms",
                "reason": ERROR,
                "policy": {
                    "kind": "openpi",
                    "name": NAMES[0],
                    "latency_p50_ms": FIGURE,
                    "latencies_ms": [FIGURE],
                },
                "tuning": {"execution_horizon": ROWS, "digest": DIGEST},
                "strategy": "rtc",
                "stages": [{"name": "warming up the policy", "state": "done", "seconds": FIGURE}],
                "setup_took": {"connect_s": FIGURE, "warm_up_s": FIGURE},
                "first_action": {"distance": FIGURE, "joint": NAMES[0], "far": False},
                "episode": {"uuid": "", "reason": ERROR},
                "last_run": {"reason": ERROR},
                "something_new": ERROR,
            }
            said |= {"sentences": within(said)}
            return json.loads(in_the_other_world(json.dumps(said))) if self.swapped else said

        return told

    def running(self):
        """Its run goes on, with chunks of the policy."""
        assert self.trial is not None
        Trial.objects.filter(pk=self.trial.pk).update(status="running", started_at=timezone.now())
        self.publish()

    def publish(self):
        joints = np.full(14, 0.1, np.float32)
        told = {"step": 7, "chunk": 3, "chunks": 2, "measured": joints, "commanded": joints, "engaged": True}
        self.runtime.publish(
            "joints", told | {"raw": np.full(14, AIM), "planned": np.full(14, AIM), "who": NAMES[0]}
        )
        chunk = {
            "chunk": 3,
            "run": 1,
            "state": ERROR,
            "rows": np.full((ROWS, 14), 0.1),
            "targets": list(range(ROWS)),
        }
        self.runtime.publish("chunk", chunk | {"ik": {"name": NAMES[0]}})

    def failed(self):
        """The policy's server is lost."""
        assert self.trial is not None
        self.runtime.emit("policy_failed", ERROR)
        self.runtime.enter(SessionEvent.CONNECTED, ERROR)
        Trial.objects.filter(pk=self.trial.pk).update(status="interrupted", reason=f"policy lost: {ERROR}")
        self._record(self.trial)

    def _record(self, trial):
        folder = self.data / "episodes" / self._folder.name
        shutil.copytree(self._folder, folder)
        for name in ("manifest.json", "outcome.json"):
            content = json.loads((folder / name).read_text())
            content |= {
                "checkpoint": {"name": NAMES[0]},
                "error": ERROR,
                "policy": {"latency_ms": FIGURE, "url": ERROR},
            }
            (folder / name).write_text(json.dumps(content))
        with (folder / "events.jsonl").open("a") as events:
            events.write(json.dumps({"kind": "policy_failed", "text": ERROR, "time": 1.0}) + "\n")
            events.write(
                json.dumps({"kind": "command", "text": f"stop by ann: failed, {ERROR}", "time": 1.0}) + "\n"
            )
        resealed(folder)
        write_export(folder, self.data)
        write_mcap(UUID(folder.name), "video", print)
        self.episode = Episode.objects.create(
            uuid=folder.name,
            station=self.station,
            status="finished",
            reason=ERROR,
            strategy="rtc",
            robot="agilex_piper",
            mode="continuous",
            checkpoint=NAMES[0],
            cameras=["cam_high"],
            fps=30.0,
            frames=24,
            duration_s=0.8,
            configuration_hash=DIGEST,
            control={"late_ms": FIGURE},
            smoothness=-FIGURE,
            smoothness_commanded=-FIGURE,
            smoothness_detail={
                "arms": {"left_arm": {"measured": -FIGURE, "commanded": -FIGURE, "measured_m": FIGURE}},
                "why": "",
            },
            policy={
                "latency_ms": {"p50": FIGURE, "p90": FIGURE, "max": FIGURE},
                "delay_steps": {"p50": 3, "max": 9},
                "answers": 5,
            },
            started_at=timezone.now(),
        )
        (self.data / "previews" / folder.name).mkdir(parents=True)
        Trial.objects.filter(pk=trial.pk).update(
            episode=self.episode, duration_s=0.8, ended_at=timezone.now()
        )
        for key, facts in (
            ("publish", {"error": ERROR}),
            ("export", {"progress": ERROR, "result": {"name": NAMES[0]}}),
        ):
            Job.objects.create(kind=key, key=f"{key}:{folder.name}", **facts)

    def scored(self):
        """Somebody has scored it."""
        assert self.trial is not None
        assert self.episode is not None
        self.trial.refresh_from_db()
        ticks = dict.fromkeys(self.scene.milestones.values_list("pk", flat=True), True)
        trials.score_trial(user=self.operator, trial=self.trial, milestones=ticks, note="fine")
        words = [[text, True, FIGURE / 1e12] for text in self.scene.milestones.values_list("text", flat=True)]
        Judgement.objects.create(
            trial=self.trial, judge="seer", version="chat 1, x", milestones=words, reason=ERROR
        )
        tags_change(
            user=self.owner, episode=self.episode, add=["slips", f"{self.trial.checkpoint.name}-slips"]
        )
        if not self.dataset:
            told = publish_episode(JobContext({"uuid": str(self.episode.uuid)}, lambda text: None))
            self.dataset = told["dataset"].removeprefix("datasets/")

    def closed(self):
        """No more trials are handed out."""
        self.plan = close_plan(user=self.owner, plan=self.plan, reason="enough")
