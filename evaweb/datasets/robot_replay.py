"""Replay of a recorded episode on a robot: values to be sent, suitability of a station, set-up arguments."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode
from uuid import UUID

from django.urls import reverse

import robots
from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotFound,
    StationGone,
)
from evaweb.datasets.dataset_orders import full_name
from evaweb.datasets.playback import PlayedEpisode, load_played_episode
from evaweb.episodes.folders import journal_folder
from evaweb.episodes.models import EpisodeStatus
from evaweb.episodes.selectors import episode_get
from evaweb.stations.commands import issue_command
from evaweb.stations.models import Command, Station
from evaweb.stations.robot_geometry import describe_robot
from evaweb.stations.runtime_client import connection_to
from runtime.core.sentences import Pattern
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError
from runtime.recording.reader import open_episode

_TAKES_NO_REPLAY_SETUP_DOES = Pattern(
    "datasets.on_robot.takes_no_replay_setup_does",
    "{kind} takes no replay: setup does",
)
_ARGS_SAY_BESIDE_REPLAY_WHICH = Pattern(
    "datasets.on_robot.args_say_beside_replay_which",
    "args say {doubled} beside the replay, which has its own: leave it out",
)
_NO_EPISODE_ALLOWED_UUID_DATASET = Pattern(
    "datasets.on_robot.no_episode_allowed_uuid_dataset",
    "{source!r:.120} is no episode; allowed: a uuid, or DATASET:INDEX",
)
_EPISODE_STILL_BEING_RECORDED = Pattern(
    "datasets.on_robot.episode_still_being_recorded",
    "episode {uuid} is still being recorded",
)
_EPISODE_DAMAGED = Pattern("datasets.on_robot.episode_damaged", "episode {uuid} is damaged: {damage}")
_SPACE_ALLOWED = Pattern("datasets.on_robot.space_allowed", "space = {space!r:.40}; allowed: {spaces}")

SPACES = {"joint": "joints", "eef": "end-effector poses"}
TAIL_S = 1.0  # time for which the last row is held before the run ends
RATE = 5.0  # inference rate [Hz]; each chunk covers at least a second


@dataclass(frozen=True, slots=True)
class PlayableEpisode:
    """Episode for replay on a robot.

    `columns` maps each action space to the dataset's column with the values in this space.
    """

    source: str  # name in URLs
    title: str
    path: str  # folder of the dataset or recording
    index: int
    rows: int
    fps: float
    task: str
    robot: str
    joints: Sequence[str]
    poses: Sequence[str]
    columns: Mapping[str, str]  # columns of a dataset by space; {} for a recording
    ours: bool  # recorded by this program, so that the frames of its poses are known

    @property
    def seconds(self) -> float:
        return self.rows / self.fps

    @property
    def page(self) -> str:
        """URL of its replay without a robot."""
        if not self.columns:
            return reverse("replay", args=[self.source])
        name, _, index = self.source.rpartition(":")
        path = reverse("dataset-replay", args=[name, int(index)])
        has_chosen_robot = not self.ours and robots.is_described(self.robot)
        return f"{path}?{urlencode({'robot': self.robot})}" if has_chosen_robot else path


@dataclass(frozen=True, slots=True)
class ReplayOffer:
    """Replay of an episode at one station in one space; `differences` are the reasons why it is impossible."""

    recorded: PlayableEpisode
    station: Station
    space: str
    differences: tuple[str, ...]
    running: bool  # the station responds

    @property
    def sent(self) -> str:
        """Description of the values that the replay sends to the station."""
        return SPACES[self.space]

    @property
    def names(self) -> Sequence[str]:
        """Names of the joints or pose values that the replay sends to the station."""
        return self.recorded.joints if self.space == "joint" else self.recorded.poses

    @property
    def asked(self) -> str:
        """Arguments of the page's request for the set-up, as JSON."""
        recorded = self.recorded
        return json.dumps({"episode": recorded.source, "space": self.space, **_assumed(recorded)})

    @property
    def set_up(self) -> dict[str, Any]:
        """Arguments of the set-up command."""
        recorded = self.recorded
        policy: dict[str, Any] = {
            "kind": "replay",
            "path": recorded.path,
            "episode": recorded.index,
            "space": self.space,
            "horizon": max(10, round(recorded.fps)),
        }
        if recorded.columns:
            key = "action" if self.space == "joint" else "action_eef"
            policy["mapping"] = {key: recorded.columns[self.space]}
        args = {"policy": policy, "strategy": {"kind": "naive", "inference_rate": RATE}}
        return args | ({"task": recorded.task[:2000]} if recorded.task else {})

    @property
    def run(self) -> str:
        """Arguments of the run command, as JSON: the run ends by itself after the last row."""
        return json.dumps({"duration_s": round(self.recorded.seconds + TAIL_S, 3)})

    @property
    def address(self) -> str:
        """URL of the page of the station on which the replay is set up and run."""
        return f"{reverse('station-debug', args=[self.station.name])}?{query(self.recorded, self.space)}"


def query(recorded: PlayableEpisode, space: str) -> str:
    """Return the query string that selects the episode and the action space ("joint" or end-effector poses)."""
    return urlencode({"replay": recorded.source, "space": space, **_assumed(recorded)})


def _assumed(recorded: PlayableEpisode) -> dict[str, str]:
    return {"robot": recorded.robot} if recorded.columns else {}


def replay_command(
    *,
    user: Any,
    station: Station,
    episode: str,
    space: str = "joint",
    robot: str = "",
    kind: str,
    args: Mapping[str, Any] | None = None,
    **given: Any,
) -> Command:
    """Send the command `setup`, which prepares a station to play an episode.

    `episode` is a uuid or DATASET:INDEX. `given` are further arguments of `issue_command`.

    Raises:
        EvaError: `kind` is not "setup".
        Conflict: The station's robot is not the episode's.
    """
    require_role(user, Role.OPERATOR)
    if kind != "setup":
        raise EvaError(_TAKES_NO_REPLAY_SETUP_DOES(kind=kind))
    offer = make_offer(playable_episode(episode, robot), station, space)
    if offer.differences:
        raise Conflict("; ".join(offer.differences))
    further = dict(args or {})
    doubled = sorted(offer.set_up.keys() & further.keys() - {"task"})
    if doubled:
        raise EvaError(_ARGS_SAY_BESIDE_REPLAY_WHICH(doubled=", ".join(doubled)))
    args = {**offer.set_up, **further}
    return issue_command(user=user, station=station, kind=kind, args=args, vouched=("policy",), **given)


def playable_episode(source: str, robot: str = "") -> PlayableEpisode:
    """Return the episode of that name, interpreted for `robot` if given. Raises: NotFound, Conflict."""
    try:
        uuid = UUID(source)
    except ValueError:
        name, _, index = source.rpartition(":")
        if not (name and index.isascii() and index.isdecimal() and len(index) < 10):
            raise NotFound(_NO_EPISODE_ALLOWED_UUID_DATASET(source=source)) from None
        try:
            return _of_dataset(load_played_episode(full_name(name), int(index), robot))
        except RecordingError as error:
            raise Conflict(str(error)) from None
    return _recording(uuid)


def _recording(uuid: UUID) -> PlayableEpisode:
    row = episode_get(uuid=uuid)
    if row.status == EpisodeStatus.RECORDING:
        raise Conflict(_EPISODE_STILL_BEING_RECORDED(uuid=uuid))
    if row.damage:
        raise Conflict(_EPISODE_DAMAGED(uuid=uuid, damage="; ".join(damage["text"] for damage in row.damage)))
    try:
        episode = open_episode(journal_folder(uuid), videos=False)
    except RecordingError as error:
        raise Conflict(str(error)) from None
    table = episode.manifest["robot"]
    robot = table if isinstance(table, Mapping) else {}
    has_poses = "eef_action" in episode.layout.streams
    return PlayableEpisode(
        source=str(uuid),
        title=row.task or "Episode without a task",
        path=str(episode.path.absolute()),
        index=0,
        rows=episode.frames,
        fps=episode.layout.fps,
        task=row.task,
        robot=str(robot.get("name", "")),
        joints=[str(name) for name in robot.get("joint_names") or ()],
        poses=[str(name) for name in robot.get("eef_names") or ()] if has_poses else (),
        columns={},
        ours=row.kind != IMPORTED,
    )


def _of_dataset(played: PlayedEpisode) -> PlayableEpisode:
    features = played.dataset.features
    action = played.action
    poses = next((name for name in ("eef_action", "action_eef") if name in features), "")
    joints = played.names(action) if action else []
    if played.robot_is_assumed:
        robot_joints = describe_robot(played.robot)["joint_names"]
        joints = robot_joints if len(robot_joints) == len(joints) else joints
    return PlayableEpisode(
        source=f"{played.name}:{played.index}",
        title=played.task or "Episode without a task",
        path=str(played.dataset.root.absolute()),
        index=played.index,
        rows=played.frames,
        fps=played.fps,
        task=played.task,
        robot=played.robot,
        joints=joints,
        poses=played.names(poses) if poses else (),
        columns={"joint": action, "eef": poses},
        ours=bool(played.uuid) and played.told.get("kind") != IMPORTED and not played.robot_is_assumed,
    )


def make_offer(recorded: PlayableEpisode, station: Station, space: str) -> ReplayOffer:
    """Return the station's offer for the episode. Raises: EvaError for an unknown space."""
    if space not in SPACES:
        raise EvaError(_SPACE_ALLOWED(space=space, spaces=", ".join(SPACES)))
    facts, running = _facts(station)
    return ReplayOffer(recorded, station, space, tuple(_differences(recorded, facts, space)), running)


def _facts(station: Station) -> tuple[Mapping[str, Any], bool]:
    """Return the robot's facts, and whether they are from the running station.

    If it does not respond, the facts are those of the robot's description.
    """
    try:
        return connection_to(station.name).status()["facts"], True
    except (StationGone, KeyError):
        return describe_robot(station.robot), False


def _differences(recorded: PlayableEpisode, facts: Mapping[str, Any], space: str) -> list[str]:
    """Return all differences between the episode's robot and the station's; [] if there are none."""
    sentences = []
    own = str(facts.get("robot", ""))
    if not robots.is_described(recorded.robot):
        called = f"calls its robot {recorded.robot!r}" if recorded.robot else "names no robot"
        return [f"the episode {called}: choose its robot on its page in Replay, then come back"]
    if recorded.robot != own:
        sentences.append(f"the episode is of the robot {recorded.robot}, the station has {own}")
    recorded_joints, station_joints = (
        list(recorded.joints),
        [str(name) for name in facts.get("joint_names", ())],
    )
    groups = [
        list(dict.fromkeys(name.partition(".")[0] for name in names))
        for names in (recorded_joints, station_joints)
    ]
    if groups[0] != groups[1]:
        sentences.append(
            f"the episode has the groups {', '.join(groups[0]) or 'none'}, the station {', '.join(groups[1])}"
        )
    elif recorded_joints != station_joints:
        sentences.append(
            f"the episode has the joints {', '.join(recorded_joints) or 'none'}, "
            f"the station {', '.join(station_joints)}"
        )
    if space == "eef" and not recorded.poses:
        sentences.append("the episode has no poses of its actions: send joints")
    elif space == "eef" and not recorded.ours:
        sentences.append(
            "the frames of its poses are not known, because it was not recorded here: send joints"
        )
    elif space == "eef" and list(facts.get("eef_names", recorded.poses)) != list(recorded.poses):
        sentences.append(f"the episode has the poses {', '.join(recorded.poses)}, the station others")
    return sentences
