"""Effects of a session, and the facts that the guards of its commands look at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from runtime.ipc.command_arguments import (
    DiscardRequest,
    GripperRequest,
    LabelRequest,
    MoveRequest,
    RunRequest,
    SetUpRequest,
    TuneRequest,
)
from runtime.ipc.messages import Mode

Told = Mapping[str, Any]  # for the data of an answer


@dataclass(frozen=True, slots=True)
class GuardFacts:
    """Facts that the guards of commands look at, beside the state."""

    mode: Mode | None = None  # of the open run
    trial: bool = False  # the open run is one of a trial: nobody may change what is measured
    proposed: bool = False  # a chunk is shown and waits to be committed
    asked: bool = False  # the policy is being asked, or its answer has not reached control
    executing: bool = False  # steps are planned
    first_action: bool = False  # the last set-up knows the policy's first action
    opening: bool = False  # the open run has not begun: its recording is being opened
    approaching: bool = False  # the robot is on its way to where the chunk that is shown begins
    collection: bool = False  # the deployment says how to collect
    collecting: bool = False  # it is set up to collect
    armed: bool = False  # a person has switched on that a collected episode may begin
    unled: str = ""  # why the leader cannot be followed just now
    doubt: str = ""  # why nothing may begin to move: joints are read where they cannot be, or are not held


class Effects(ABC):
    """Effects of the session; implemented by the coordinator, recorded by tests.

    Each raises RuntimeFault to refuse, and has changed nothing then. What is returned goes into the answer.
    `by` names the client whose command is being carried out, `command` is its uuid.
    """

    by: str = ""
    command: str = ""

    def attribute(self, by: str, command: str) -> None:
        """What is carried out next was asked for by `by`, in the command with that uuid."""
        self.by, self.command = by, command

    @property
    @abstractmethod
    def situation(self) -> GuardFacts: ...

    @abstractmethod
    def begin_setup(self, asked: SetUpRequest) -> Told: ...

    @abstractmethod
    def cancel_setup(self, reason: str) -> None: ...

    @abstractmethod
    def begin_run(self, asked: RunRequest) -> Told: ...

    @abstractmethod
    def hold(self, reason: str) -> None:
        """Decelerate, hold, stop asking the policy; a run stays open."""

    @abstractmethod
    def resume_run(self) -> None: ...

    @abstractmethod
    def end_run(self, status: str, reason: str) -> None:
        """Decelerate, hold, close the run and its episode; nothing to do where no run is open."""

    @abstractmethod
    def go_home(self) -> None: ...

    @abstractmethod
    def release_estop(self) -> None: ...

    @abstractmethod
    def start_recording(self) -> Told: ...

    @abstractmethod
    def stop_recording(self) -> None: ...

    @abstractmethod
    def tune(self, asked: TuneRequest) -> Told:
        """Another strategy, other parameters, another instruction from now on."""

    @abstractmethod
    def step(self) -> None:
        """Ask for one chunk: to be executed in the mode step, to be shown in preview."""

    @abstractmethod
    def commit(self) -> None:
        """Execute the chunk that is shown."""

    @abstractmethod
    def cancel(self) -> None:
        """Forget the chunk that is shown, leave the rest of the one that is executed, end a motion; hold."""

    @abstractmethod
    def move(self, asked: MoveRequest) -> Told: ...

    @abstractmethod
    def grip(self, asked: GripperRequest) -> Told: ...

    @abstractmethod
    def approach(self) -> None:
        """Go to the policy's first action on a limited path: the one of the set-up, or the one that is shown."""

    @abstractmethod
    def arm(self) -> None:
        """A collected episode may begin from now on."""

    @abstractmethod
    def disarm(self) -> None: ...

    @abstractmethod
    def label(self, asked: LabelRequest) -> Told: ...

    @abstractmethod
    def discard(self, asked: DiscardRequest) -> Told:
        """Mark an episode as discarded; the open one ends, as by `end_run`, where none is named."""
