"""Schema of a deployment file: one declarative table per part."""

from __future__ import annotations

import os
from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from runtime.config.collection import CollectionSettings
from runtime.core.errors import ConfigurationError
from runtime.core.plugins import kind_union, union_members, variants
from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.core.types import Space
from runtime.ipc.messages import PolicyMode
from runtime.kinematics.base import KinematicsSettings
from runtime.recording.settings import RecordingSettings
from runtime.safety.filter import SafetySettings
from runtime.strategies.base import StrategyParameters

if TYPE_CHECKING:

    class Variant(Settings):
        """Keys that all variants have in common."""

        kind: str

    TransportConfig = Variant
    PolicyConfig = Variant
    CameraConfig = Variant

    class KinematicsConfig(KinematicsSettings):
        """Any backend's section."""

        kind: str

    class StrategyConfig(StrategyParameters):
        """Any strategy's section."""

        kind: str
else:
    TransportConfig = kind_union("runtime.transports")
    PolicyConfig = kind_union("runtime.policies")
    StrategyConfig = kind_union("runtime.strategies")
    CameraConfig = kind_union("runtime.cameras")
    KinematicsConfig = kind_union("runtime.kinematics")


# Former keys of the bus, from the time when it used ports.
REMOVED_BUS_KEYS = ("host", "command_port", "state_port", "camera_port", "estop_port")
_NO_PORTS = (
    "the bus has no ports any more, but Unix sockets that this account alone can reach, in $XDG_RUNTIME_DIR/eva-web "
    "(docs/security.md): leave it out"
)


def policy_tables() -> tuple[type[Settings], ...]:
    """Return the models of a [policy] table, one per kind."""
    return union_members(PolicyConfig)


def strategy_tables() -> tuple[type[Settings], ...]:
    """Return the models of a [strategy] table, one per kind."""
    return union_members(StrategyConfig)


class ControlSettings(Settings):
    """The control loop."""

    rate: float | None = Field(default=None, gt=0, le=1000)
    """Ticks per second [Hz]; the robot's own rate where it is not given."""
    realtime: Literal["auto", "off"] = "auto"
    """"auto" asks for SCHED_FIFO and locked memory and says what it got; "off" does not ask. Reception and guard
    likewise, one priority below."""
    realtime_priority: int = Field(default=20, ge=1, le=99)
    """Priority within SCHED_FIFO."""
    heartbeat_timeout_s: float = Field(default=1.0, gt=0)
    """Silence of control, guard or reception after which the robot is held [s]."""
    coordinator_timeout_s: float = Field(default=3.0, gt=0)
    """Silence of the coordinator after which control holds, and the recorder ends its episode [s]: it decides what
    comes next and stops nothing, so that a busy machine may keep it longer."""
    orphan_hold_s: float = Field(default=5.0, ge=0, le=8)
    """How long control goes on holding after its supervisor has died [s]."""
    starvation_hold_s: float = Field(default=1.0, gt=0)
    """Time without any planned action after which `running` becomes `holding` [s]."""


class SetupSettings(Settings):
    """A set-up: homing, the first observation, warming up the policy."""

    home: bool = True
    """Drive to the pose before the policy is warmed up; skipped where the transport moves no robot."""
    pose: str = "home"
    """Named pose of the robot to home to."""
    warmup_chunks: int = Field(default=2, ge=1)
    """Inferences before the first run; the first compiles the model on many servers."""
    observation_timeout_s: float = Field(default=10.0, gt=0)
    """How long to wait for a complete first observation [s]."""


class RunSettings(Settings):
    """A run."""

    duration_s: float | None = Field(default=None, gt=0)
    """Time after which a run ends by itself [s]; until it is stopped where it is not given."""
    mode: PolicyMode = "continuous"
    """"continuous": the policy drives the robot until the run ends; "step": one chunk per command; "preview":
    each chunk is shown, then committed or cancelled; "sim": actions go to the 3D scene alone; "manual": a person
    moves it."""
    sim_state: Literal["live", "simulated"] = "simulated"
    """What the policy is shown as the robot's state in "sim": the robot's own, or that of the simulated one."""


FaultResponse = Literal["hold", "slow", "stop"]


class FaultSettings(Settings):
    """Answers to a failing policy: "hold" at once; "slow": hold after what is planned; "stop": end the run.

    "slow" goes on with what is planned, then decelerates, holds, and goes on by itself if the policy is
    back in time.
    """

    starvation: FaultResponse = "slow"
    """Nothing is planned for a step; after control.starvation_hold_s "slow" holds."""
    policy_error: FaultResponse = "hold"
    """The policy answered with an error, or with something unusable."""
    policy_lost: FaultResponse = "slow"
    """The policy did not answer in time, or its connection was lost; it is tried again with back-off."""
    patience_s: float = Field(default=3.0, gt=0)
    """Longest time without an answer before "slow" holds, also for a strategy that waits [s]."""


class RecordingChoice(RecordingSettings):
    """Recording of every run."""

    enabled: bool = True
    """Whether runs are recorded; one that is not leaves nothing behind, and a trial is refused."""
    fps: float | None = Field(default=None, gt=0)
    """Rows per second of the dataset grid; the control rate where it is not given."""
    kind: Literal["rollout", "demonstration"] = "rollout"
    """What the episodes are, for the manifest and the dataset."""
    export: bool = True
    """Whether the streams of every run are exported as one table when it is closed."""
    on_failure: Literal["hold", "continue"] = "hold"
    """What a run does when its recording fails: an unrecorded run is no evidence. Trials and demonstrations never begin
    without."""


class PublishSettings(Settings):
    """The LeRobot dataset that finished episodes go to."""

    dataset: str | None = None
    """Folder of the dataset, relative to the data folder; nothing is published where it is not given."""
    version: Literal["v2.1", "v3.0"] | None = None
    """Version of the format of a new dataset, v2.1 where it is not given; one that is there keeps its own."""


class PublicationSettings(Settings):
    """Commands to the robot: joints, or poses beside them where the transport takes such a command."""

    space: Space = "joint"
    """"eef" publishes the poses that the safe joint command amounts to along with the joints."""
    pose: PoseFormat = PoseFormat()
    """How these poses are written."""


class LeaseSettings(Settings):
    """The right to command, and how long it lasts."""

    ttl_s: float = Field(default=5.0, gt=0)
    """Time after which a lease that is not renewed ends and the robot holds [s]."""
    lost: Literal["hold", "finish"] = "hold"
    """What a run does whose lease ends because nothing is heard of its holder: "hold"; or "finish": a scored run with a
    time limit goes on to its end, other runs hold. "finish" needs a [panel], and holds where that is not served."""


class PanelSettings(Settings):
    """The station's own panel, a page on its own machine for whoever stands beside the robot."""

    host: str = "127.0.0.1"
    """Address at which it listens; beyond this machine only with a certificate."""
    port: int = Field(default=8480, ge=0, le=65535)
    """Port at which it listens; 0 for a free one, which is left in the station's folder."""
    names: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]{1,253}$")]] = Field(default_factory=list)
    """Names by which browsers reach it, beside localhost and addresses in numbers; others are refused."""
    certificate: str | None = None
    """File of its certificate, with the chain, as PEM."""
    key: str | None = None
    """File of the certificate's key, as PEM."""

    @model_validator(mode="after")
    def _is_encrypted_beyond_this_machine(self) -> PanelSettings:
        if (self.certificate is None) != (self.key is None):
            raise ConfigurationError("panel.certificate and panel.key belong together: give both, or neither")
        try:
            address = ip_address(self.host)
        except ValueError:
            raise ConfigurationError(
                f"panel.host = {self.host!r:.100}: must be an address in numbers, as 127.0.0.1 or 0.0.0.0"
            ) from None
        if self.certificate is None and not address.is_loopback:
            raise ConfigurationError(
                f"panel.host = {self.host!r}: beyond this machine it needs panel.certificate and panel.key; allowed "
                "without: 127.0.0.1"
            )
        return self


class BusSettings(Settings):
    """Camera previews that the station publishes for clients that watch."""

    preview_rate: float = Field(default=15.0, ge=0, le=60)
    """JPEG previews per second and camera [Hz]; 0 for none."""
    preview_height: int = Field(default=240, ge=60, le=1080)
    """Height of a preview [pixels]."""


class ControlChannelSettings(Settings):
    """JSON commands over ZMQ for existing scripts, on this machine alone: docs/control-channel.md."""

    enabled: bool = False
    """Whether the station listens for scripts."""
    port: int = Field(default=5757, ge=0, le=65535)
    """Where, on 127.0.0.1; 0 for a free port, which is left in the station's folder."""
    operator: str = Field(default="", max_length=100)
    """Who the scripts command for, in lease and events; user and machine where it is not given."""
    silence_s: float = Field(default=10.0, gt=0, le=3600)
    """Silence of a script after which its lease ends and the robot holds [s]."""
    scripts: Literal["apart", "together"] = "together"
    """"together": all scripts that give themselves no name are one holder, also with a connection for every message;
    "apart": each connection is one."""


class SecuritySettings(Settings):
    """Variables and files of the station that a table from the web, as a checkpoint's, may name."""

    variables: list[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\*?$")]] = Field(
        default=["EVA_POLICY_*"]
    )
    """Environment variables with keys of policy servers; * at the end stands for anything. Those that [policy] itself
    names are allowed in any case."""
    files: list[Annotated[str, Field(pattern=r"^(/|~/)")]] = Field(default_factory=list)
    """Keys and configurations of ssh, and recordings, or folders of them, outside of ssh/ in the station's folder and
    of the data folder. Those that [policy] itself names are allowed in any case."""


class LockstepSettings(Settings):
    """One process on a virtual clock."""

    delay_ticks: int = Field(default=0, ge=0)
    """Ticks between an observation and the arrival of its chunk."""


class GripperSettings(Settings):
    """Settings of a deployment for one gripper that differ from the robot's description."""

    binary: bool | None = None
    """Whether it knows only open and close."""
    threshold: float | None = None
    """Where a binary gripper switches, in its own unit."""
    hysteresis: float | None = Field(default=None, ge=0, lt=1)
    """Around the threshold, the part of its travel within which a binary gripper stays as it was."""
    open: float | None = None
    """Its number when open."""
    close: float | None = None
    """Its number when closed."""


class Deployment(Settings):
    """One station: a robot, a way to it, a policy, and how they are brought together."""

    GONE: ClassVar[Mapping[str, str]] = {f"bus.{key}": _NO_PORTS for key in REMOVED_BUS_KEYS}
    """Keys that there were, and what is in their place."""

    station: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")
    """Name of the station, and of its folder in the data folder."""
    robot: str
    """Name of a robot that comes with the program or lies in a folder of $EVA_ROBOTS, or a path to a robot's folder."""
    groups: list[str] | None = None
    """Groups of its joints that are part of this station; all that are not optional where they are not given."""
    grippers: dict[str, GripperSettings] = Field(default_factory=dict)
    """By the name of the group, what this station's grippers have otherwise."""
    task: str = ""
    """The instruction given to the policy."""
    tasks: list[str] = Field(default_factory=list)
    """Further instructions, offered to choose from."""
    operator: str = ""
    """Who runs it, for the manifests."""
    data_dir: str | None = None
    """Where episodes and datasets lie; $EVA_DATA_DIR or ./data where it is not given."""
    transport: TransportConfig
    cameras: dict[str, CameraConfig] = Field(default_factory=dict)
    """By the camera's key in the robot's description, those that do not come from the transport."""
    policy: PolicyConfig = Field(default_factory=lambda: variants("runtime.policies")["none"].Config())
    """Who is asked for actions; may be left out where there is a [collection]."""
    collection: CollectionSettings | None = None
    """Collecting demonstrations; a station without it collects none."""
    kinematics: KinematicsConfig = Field(
        default_factory=lambda: variants("runtime.kinematics")["compiled"].Config()
    )
    strategy: StrategyConfig = Field(default_factory=lambda: variants("runtime.strategies")["async"].Config())
    control: ControlSettings = ControlSettings()
    setup: SetupSettings = SetupSettings()
    run: RunSettings = RunSettings()
    faults: FaultSettings = FaultSettings()
    safety: SafetySettings = SafetySettings()
    recording: RecordingChoice = RecordingChoice()
    publish: PublishSettings = PublishSettings()
    publication: PublicationSettings = PublicationSettings()
    lease: LeaseSettings = LeaseSettings()
    panel: PanelSettings | None = None
    """The station's own panel; a station without it has none."""
    bus: BusSettings = BusSettings()
    control_channel: ControlChannelSettings = ControlChannelSettings()
    security: SecuritySettings = SecuritySettings()
    lockstep: LockstepSettings = LockstepSettings()

    @model_validator(mode="after")
    def _have_something_to_do(self) -> Deployment:
        if self.policy.kind == "none" and self.collection is None:
            raise ConfigurationError(
                "policy is missing and has no default; it may be left out with a [collection]"
            )
        return self

    @model_validator(mode="after")
    def _can_be_stopped_without_the_lab(self) -> Deployment:
        if self.lease.lost == "finish" and self.panel is None:
            raise ConfigurationError(
                'lease.lost = "finish": the robot goes on while nobody commands it, so somebody beside it must be able '
                'to stop it; allowed with a [panel], else "hold"'
            )
        return self

    def heartbeat_timeout_s(self, process: str) -> float:
        """Return the silence after which `process` counts as dead [s]; shortest for those that stop the robot."""
        if process == "media":
            return self.recording.heartbeat_timeout_s
        return (
            self.control.coordinator_timeout_s
            if process == "coordinator"
            else self.control.heartbeat_timeout_s
        )

    @property
    def data(self) -> Path:
        """Absolute data folder."""
        return Path(self.data_dir or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()

    @property
    def station_dir(self) -> Path:
        """Folder with the station's latch, command journal and endpoints."""
        return self.data / "stations" / self.station

    @property
    def ssh_dir(self) -> Path:
        """Folder for files that checkpoints name for ssh: keys, known hosts, configurations."""
        return self.station_dir / "ssh"

    @property
    def episodes_dir(self) -> Path:
        """Folder of the journals."""
        return self.data / "episodes"
