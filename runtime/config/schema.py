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
    """Control rate: ticks per second [Hz]; absent: the robot's own rate."""
    realtime: Literal["auto", "off"] = "auto"
    """"auto" requests SCHED_FIFO and locked memory, and reports what was granted; "off" requests neither. Reception and
    guard do the same, one priority below."""
    realtime_priority: int = Field(default=20, ge=1, le=99)
    """SCHED_FIFO priority of control, with realtime = "auto"."""
    heartbeat_timeout_s: float = Field(default=1.0, gt=0)
    """Silence of control, guard or reception after which the robot is held [s]."""
    coordinator_timeout_s: float = Field(default=3.0, gt=0)
    """Silence of the coordinator after which control holds and the recorder ends its episode [s]. The coordinator
    decides what comes next and stops nothing, so that a busy machine may delay it for longer."""
    orphan_hold_s: float = Field(default=5.0, ge=0, le=8)
    """Time for which control continues to hold the robot after its supervisor has died [s]."""
    starvation_hold_s: float = Field(default=1.0, gt=0)
    """Time without any planned action after which the state changes from `running` to `holding` [s]."""


class SetupSettings(Settings):
    """Set-up: homing, first observation, and warm-up of the policy."""

    home: bool = True
    """Whether the robot is driven to `pose` before the policy is warmed up; skipped if the transport moves no robot."""
    pose: str = "home"
    """Named pose of the robot for homing."""
    warmup_chunks: int = Field(default=2, ge=1)
    """Number of inferences before the first run; on many servers the first one compiles the model."""
    observation_timeout_s: float = Field(default=10.0, gt=0)
    """Longest wait for a complete first observation [s]."""


class RunSettings(Settings):
    """Duration and mode of a run, unless the command that starts it names others."""

    duration_s: float | None = Field(default=None, gt=0)
    """Time after which a run ends by itself [s]; absent: it continues until it is stopped."""
    mode: PolicyMode = "continuous"
    """"continuous": the policy drives the robot until the run ends; "step": one chunk per command; "preview": each
    chunk is shown, then committed or cancelled; "sim": actions go only to the 3D scene; "manual": a person moves the
    robot."""
    sim_state: Literal["live", "simulated"] = "simulated"
    """State that the policy receives in mode "sim": "live": the real robot's; "simulated": the simulated robot's."""


FaultResponse = Literal["hold", "slow", "stop"]


class FaultSettings(Settings):
    """Responses to a failing policy: "hold": at once; "slow": hold after the planned actions; "stop": end the run.

    "slow" executes the planned actions, then decelerates and holds, and resumes by itself if the policy is back in
    time.
    """

    starvation: FaultResponse = "slow"
    """Response if nothing is planned for a step; "slow" holds after control.starvation_hold_s."""
    policy_error: FaultResponse = "hold"
    """Response if the policy returns an error or unusable data."""
    policy_lost: FaultResponse = "slow"
    """Response if the policy does not answer in time or its connection is lost; connecting is retried with back-off."""
    patience_s: float = Field(default=3.0, gt=0)
    """Longest time without a response of the policy before "slow" holds [s], also for a strategy that waits."""


class RecordingChoice(RecordingSettings):
    """Recording of every run."""

    enabled: bool = True
    """Whether runs are recorded; a run without recording leaves no data, and trials are refused."""
    fps: float | None = Field(default=None, gt=0)
    """Rows per second of the dataset grid [Hz]; absent: the control rate."""
    kind: Literal["rollout", "demonstration"] = "rollout"
    """Kind of the episodes, stored in the manifest and the dataset."""
    export: bool = True
    """Whether the streams of every run are exported as one table when its recording is closed."""
    on_failure: Literal["hold", "continue"] = "hold"
    """Response of a run to a failure of its recording; "hold" because an unrecorded run is no evidence. Trials and
    demonstrations never begin without recording."""


class PublishSettings(Settings):
    """LeRobot dataset to which finished episodes are published."""

    dataset: str | None = None
    """Folder of the dataset, relative to the data folder; absent: nothing is published."""
    version: Literal["v2.1", "v3.0"] | None = None
    """Format version of a new dataset; absent: v2.1. An existing dataset keeps its version."""


class PublicationSettings(Settings):
    """Commands to the robot: joints, and also end-effector poses if the transport accepts them."""

    space: Space = "joint"
    """"eef" publishes the poses that result from the safe joint command, in addition to the joints."""
    pose: PoseFormat = PoseFormat()
    """Format of these poses."""


class LeaseSettings(Settings):
    """The right to command: its duration, and the response to its loss."""

    ttl_s: float = Field(default=5.0, gt=0)
    """Time after which a lease that is not renewed ends and the robot holds [s]."""
    lost: Literal["hold", "finish"] = "hold"
    """Response of a run if the lease ends because its holder is silent. "hold": the run holds; "finish": a scored run
    with a time limit continues to its end, other runs hold. "finish" needs a [panel], and holds if the panel is not
    served."""


class PanelSettings(Settings):
    """The station's own panel: a web page on its own machine for the person next to the robot."""

    host: str = "127.0.0.1"
    """IP address at which the panel listens; an address beyond this machine needs a certificate."""
    port: int = Field(default=8480, ge=0, le=65535)
    """TCP port at which the panel listens; 0: a free port, which is recorded in the station's folder."""
    names: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]{1,253}$")]] = Field(default_factory=list)
    """Host names by which browsers reach the panel, besides localhost and numeric addresses; others are refused."""
    certificate: str | None = None
    """Path of the panel's certificate with its chain, as PEM; needs `key`."""
    key: str | None = None
    """Path of the certificate's private key, as PEM; needs `certificate`."""

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
    """Camera previews that the station publishes for its clients."""

    preview_rate: float = Field(default=15.0, ge=0, le=60)
    """JPEG previews per second and camera [Hz]; 0: no previews."""
    preview_height: int = Field(default=240, ge=60, le=1080)
    """Height of a preview [pixels]."""


class ControlChannelSettings(Settings):
    """JSON commands over ZMQ for existing scripts, only from this machine: docs/control-channel.md."""

    enabled: bool = False
    """Whether the station accepts connections from scripts."""
    port: int = Field(default=5757, ge=0, le=65535)
    """TCP port on 127.0.0.1; 0: a free port, which is recorded in the station's folder."""
    operator: str = Field(default="", max_length=100)
    """Name of the scripts' operator in the lease and in events; empty: user and machine."""
    silence_s: float = Field(default=10.0, gt=0, le=3600)
    """Silence of a script after which its lease ends and the robot holds [s]."""
    scripts: Literal["apart", "together"] = "together"
    """"together": all scripts that give no name are one lease holder, even with a connection for every message;
    "apart": each connection is a holder of its own."""


class SecuritySettings(Settings):
    """Environment variables and files of the station that a table from the web, such as a checkpoint's, may name."""

    variables: list[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\*?$")]] = Field(
        default=["EVA_POLICY_*"]
    )
    """Environment variables with keys of policy servers; a trailing * matches any suffix. Variables named in the
    deployment's own [policy] are always allowed."""
    files: list[Annotated[str, Field(pattern=r"^(/|~/)")]] = Field(default_factory=list)
    """Paths of ssh keys, ssh configurations and recordings, or of folders of them, besides the ssh/ folder in the
    station's folder and the data folder. Files named in the deployment's own [policy] are always allowed."""


class LockstepSettings(Settings):
    """Operation of the station as one process on a virtual clock."""

    delay_ticks: int = Field(default=0, ge=0)
    """Ticks between an observation and the arrival of its chunk."""
    benchmark: bool = False
    """Whether a simulated bench is run as published benchmarks are: it waits for the policy, gets each row as it was
    given (float32, neither limited nor blended with others), and a run ends with the first success. Needs a simulated
    transport, strategy "sync", safety.report_only = true and no delays."""


class GripperSettings(Settings):
    """Settings of a deployment for one gripper that differ from the robot's description."""

    binary: bool | None = None
    """Whether the gripper can only open and close."""
    threshold: float | None = None
    """Value at which a binary gripper switches, in the gripper's unit."""
    hysteresis: float | None = Field(default=None, ge=0, lt=1)
    """Share of the travel, around the threshold, within which a binary gripper keeps its state."""
    open: float | None = None
    """Value when open, in the gripper's unit."""
    close: float | None = None
    """Value when closed, in the gripper's unit."""


class Deployment(Settings):
    """One station: its robot, transport and policy, and how they work together."""

    GONE: ClassVar[Mapping[str, str]] = {f"bus.{key}": _NO_PORTS for key in REMOVED_BUS_KEYS}
    """Removed keys, each with a message about its replacement."""

    station: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")
    """Name of the station and of its folder in the data folder."""
    robot: str
    """Name of a robot shipped with the program or found in a folder of $EVA_ROBOTS, or path of a robot's folder."""
    groups: list[str] | None = None
    """Joint groups of the robot that are part of this station; absent: all that are not optional."""
    grippers: dict[str, GripperSettings] = Field(default_factory=dict)
    """Settings of this station's grippers that differ from the robot's description, by group name."""
    task: str = ""
    """Instruction for the policy."""
    tasks: list[str] = Field(default_factory=list)
    """Further instructions from which an operator can choose."""
    operator: str = ""
    """Name of the operator, for the manifests."""
    data_dir: str | None = None
    """Folder of episodes and datasets; absent: $EVA_DATA_DIR, else ./data."""
    transport: TransportConfig
    cameras: dict[str, CameraConfig] = Field(default_factory=dict)
    """Cameras whose images do not come from the transport, by their key in the robot's description."""
    policy: PolicyConfig = Field(default_factory=lambda: variants("runtime.policies")["none"].Config())
    """Source of the actions; optional with a [collection]."""
    collection: CollectionSettings | None = None
    """Collection of demonstrations; absent: the station collects none."""
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
    """The station's own panel; absent: the station has none."""
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
                'lease.lost = "finish": the robot moves on while it has no operator, so a person beside it '
                'must be able to stop it; allowed with a [panel], else "hold"'
            )
        return self

    @model_validator(mode="after")
    def _is_exact_as_a_benchmark(self) -> Deployment:
        if self.lockstep.benchmark:
            self._require_exact()
        return self

    def _require_exact(self) -> None:
        """Raise ConfigurationError if something would change or delay rows on their way to a benchmark's bench."""
        delay = getattr(self.policy, "delay_ms", None)
        needed: tuple[tuple[str, object, bool, str], ...] = (
            (
                "transport.simulated",
                getattr(self.transport, "simulated", False),
                bool(getattr(self.transport, "simulated", False)),
                "true: a robot cannot wait",
            ),
            (
                "strategy.kind",
                self.strategy.kind,
                self.strategy.kind == "sync",
                '"sync": others blend or skip rows',
            ),
            (
                "safety.report_only",
                self.safety.report_only,
                self.safety.report_only,
                "true: rows are not limited",
            ),
            (
                "lockstep.delay_ticks",
                self.lockstep.delay_ticks,
                self.lockstep.delay_ticks == 0,
                "0: the bench waits",
            ),
            ("policy.delay_ms", delay, not delay or delay == [0.0], "none, or 0: the bench waits"),
        )
        for key, given, fits, allowed in needed:
            if not fits:
                raise ConfigurationError(
                    f"{key} = {given!r} with lockstep.benchmark = true; allowed: {allowed}"
                )

    def heartbeat_timeout_s(self, process: str) -> float:
        """Return the time without heartbeat after which `process` counts as dead [s].

        It is shortest for the processes that stop the robot.
        """
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
