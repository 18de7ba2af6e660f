"""Session of one program that drives the station: lease, set-up, run, end; a station that stops ends it for good."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from runtime.clients.client import Refused, StationClient
from runtime.clients.robot_server.exchange import LatestObservation, RowExchange
from runtime.core.errors import RuntimeFault

log = logging.getLogger(__name__)
PROTOCOL = 1
DRIVERS = ("policy", "person")
SETUP_S = 240.0
RUN_S = 30.0
CLOSE_S = 60.0
_POLL_S = 0.1
_FRESH_S = 0.5  # an older observation is not handed out [s]
_PATIENCE_S = 3.0  # for the next observation [s]
_READING_S = 10.0  # for the program to read an answer [s]
_SEEDS = 2**31
_RETRY_S = 1.0  # after the station has not answered [s]


class SessionError(RuntimeFault):
    """Error of a request; `is_over` means that the run has ended and that every further row will be refused.

    `is_stopped` means that it ended with a station that is ready for another run.
    """

    def __init__(self, message: str, is_over: bool = False, is_stopped: bool = False) -> None:
        super().__init__(message)
        self.is_over = is_over
        self.is_stopped = is_stopped


class DriveSession:
    """Session of one program. Its methods are called by one thread; another one renews the lease and polls the state.

    A run that the station ends for whatever reason (e-stop, hold, stop by a person, lost lease) is over: from then on
    `observe` and `act` raise SessionError with the reason, until the next `begin`.
    """

    def __init__(self, client: StationClient, exchange: RowExchange, program: str) -> None:
        self._client = client
        self._exchange = exchange
        self._program = program
        self._lock = threading.Lock()  # of the client
        self._over = "no run has begun: begin one first"
        self._is_stopped = False
        self._has_run = False
        self._has_lease = False
        self._episode = ""
        self._run_number = 0  # of this session's run, 0 while it is unknown
        self.sending_since: float | None = None  # an answer that the program has not read yet [s]
        self._dim = 0
        self._cameras: frozenset[str] = frozenset()
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._poll, name="session", daemon=True)
        self._watch.start()

    def describe(self) -> dict[str, Any]:
        """Return what a program has to know of the robot before it drives. Raises: TransportError."""
        with self._lock:
            status = self._client.status()
        return describe_station(status)

    def begin(
        self,
        task: str,
        is_connected: Callable[[], bool],
        duration_s: float | None = None,
        seed: int | None = None,
        driver: str = "policy",
    ) -> dict[str, Any]:
        """Claim the lease, set the station up at its start pose and begin a run; return its episode.

        Args:
            task: Instruction; "" for that of the station.
            is_connected: False ends the set-up, because the program has gone.
            duration_s: Limit of the run [s]; None for that of the station.
            seed: Lays out the station's simulated bench; None draws one.
            driver: "policy", or "person" for a demonstration.

        Raises:
            SessionError: The set-up fails; the message is its reason.
            Refused: The station refuses the lease or a command.
            TransportError: The station does not answer.
        """

        def is_settled(state: Mapping[str, Any]) -> bool:
            if state["state_is"]["preparing"] and not is_connected():
                self._client.command("stop")
                raise SessionError("the program has gone during the set-up")
            return not state["state_is"]["preparing"]

        with self._lock:
            self._end_run()
            self._client.claim()
            self._has_lease = True
            try:
                self._begin(task, is_settled, duration_s, seed, driver)
            except RuntimeFault:
                if not self._has_run:
                    self._release()
                raise
        self._wait_for_observation(RUN_S)  # it follows the reset of the policy, which forgets an earlier row
        return {"episode": self._episode}

    def _begin(
        self,
        task: str,
        is_settled: Callable[[Mapping[str, Any]], bool],
        duration_s: float | None,
        seed: int | None,
        driver: str,
    ) -> None:
        """Set the station up and begin a run; under the lock and the lease."""
        status = self._client.status()
        facts = status["facts"]
        self._dim, self._cameras = len(facts["joint_names"]), frozenset(facts["cameras"])
        policy = {"kind": "external", "socket_file": self._exchange.socket_path, "client": self._program}
        policy["driver"] = driver
        strategy = {"kind": "naive", "inference_rate": facts["rate"], "execution_horizon": None}
        arguments: dict[str, Any] = {"policy": policy, "strategy": strategy}
        arguments |= {"task": task} if task else {}
        if facts["bench"] is not None or seed is not None:  # a bench is laid out anew, as for every trial
            arguments["bench"] = {"seed": secrets.randbelow(_SEEDS) if seed is None else seed}
        self._client.command("setup", **arguments)
        status = self._client.wait(is_settled, SETUP_S)
        if not status["state_is"]["ready"]:
            raise SessionError(f"set-up failed: {status['reason']}")
        self._exchange.begin()  # what the set-up has requested is no observation of the run
        limit: dict[str, Any] = {"duration_s": duration_s} if duration_s else {}
        self._has_run, self._run_number, self._episode = True, 0, ""  # also if the answer does not arrive
        ack = self._client.command("run", timeout=RUN_S, mode="continuous", **limit)
        self._episode = str(ack.data.get("episode", ""))
        self._run_number = int(self._client.status()["run"]["number"])
        self._over, self._is_stopped = "", False

    def observe(self) -> LatestObservation:
        """Return the newest observation. Raises: SessionError if the run is over, or if there is none in time."""
        return self._wait_for_observation(_PATIENCE_S)

    def _wait_for_observation(self, patience: float) -> LatestObservation:
        self._require_run()
        deadline = time.monotonic() + patience
        while True:
            newest = self._exchange.wait_for_observation(self._cameras, time.monotonic() - _FRESH_S, _POLL_S)
            self._require_run()
            if newest is not None:
                return newest
            if time.monotonic() > deadline:
                raise SessionError(
                    f"the station has passed on no observation with pictures of {', '.join(sorted(self._cameras))} "
                    f"for {patience:g} s"
                )

    def act(self, row: object) -> None:
        """Send a row [D], which is executed from the next control step on until there is another one.

        Raises:
            SessionError: The run is over, or the row does not fit the robot; the row is not executed then.
        """
        self._require_run()
        if not isinstance(row, np.ndarray) or row.dtype.kind != "f" or row.shape != (self._dim,):
            given = f"{row.dtype} {list(row.shape)}" if isinstance(row, np.ndarray) else type(row).__name__
            raise SessionError(f"a row of {given}; expected {self._dim} floating-point numbers")
        with np.errstate(over="ignore"):
            sent = row.astype(np.float32)
        if not np.isfinite(sent).all():
            raise SessionError(f"a row of {row.tolist()}; expected finite numbers")
        self._exchange.set_row(sent)

    def end(self) -> dict[str, Any]:
        """Stop the run, wait until its episode is closed, release the lease and return the episode.

        Raises: RuntimeFault.
        """
        with self._lock:
            ended = self._end_run()
            self._release()
            return ended

    def close(self, reason: str) -> None:
        """End the run, if one is open, and the lease; problems are logged. Safe to call twice."""
        self._ended.set()
        if threading.current_thread() is not self._watch:
            self._watch.join()
        with self._lock:
            self._over = reason
            try:
                self._end_run()
            except RuntimeFault as fault:
                log.warning("the run of %s could not be ended: %s", self._program, fault)
            self._release()
            self._client.close()
        self._exchange.close()

    def _require_run(self) -> None:
        if self._over:
            raise SessionError(self._over, is_over=True, is_stopped=self._is_stopped)

    def _end_run(self) -> dict[str, Any]:
        """Stop a run of this session that is still open, and return its episode; under the lock."""
        if not self._has_run:
            return {"episode": "", "status": ""}
        self._over = self._over or "the program has ended the run"
        self._has_run = False
        self._exchange.set_row(None)
        status = self._client.status()
        is_ours = self._run_number in (0, status["run"]["number"])
        if not status["state_is"]["run_open"] or not is_ours:
            last = status["last_run"] or {}
            return {"episode": self._episode, "status": str(last.get("status", "")) if is_ours else ""}
        self._client.command("stop")
        status = self._client.wait(
            lambda state: not state["state_is"]["run_open"] and not state["recording"]["uuid"], CLOSE_S
        )
        last = status["last_run"] or {}
        return {"episode": self._episode, "status": str(last.get("status", ""))}

    def _poll(self) -> None:
        """Renew the lease and follow the station's state until the session is closed."""
        while not self._ended.wait(_POLL_S):
            if not self._has_lease:
                continue
            with self._lock:
                try:
                    self._follow()
                except Refused as refusal:  # somebody else has the lease, or the station was restarted
                    self._has_lease = False
                    self._note_end(f"{refusal}")
                except RuntimeFault as fault:
                    self._note_end(f"{fault}")
                    self._ended.wait(_RETRY_S)
                except Exception:  # the run must not go on without the thread that ends it
                    log.exception("the session of %s", self._program)
                    self._note_end("the robot server has failed: its log says why")
                    self._ended.wait(_RETRY_S)

    def _follow(self) -> None:
        """Renew the lease and read the station's state; end what a program that does not read its answers holds."""
        since = self.sending_since
        if since is not None and time.monotonic() - since > _READING_S:
            self._note_end(f"the program has not read an answer for {_READING_S:g} s")
            self._end_run()
            self._release()
            return
        self._client.renew()
        status = self._client.status()
        holder = status["lease"]["holder"]
        if holder != self._client.holder:
            raise Refused(f"{holder or 'nobody'} holds the lease")
        if self._has_run and not status["state_is"]["going"]:
            self._is_stopped = bool(status["state_is"]["ready"])
            self._note_end(f"the station is {status['state']}: {status['reason']}")

    def _release(self) -> None:
        """Release the lease, if there is one."""
        try:
            if self._has_lease:
                self._client.release()
        except RuntimeFault as fault:
            log.info("the lease of %s had ended already: %s", self._program, fault)
        self._has_lease = False

    def _note_end(self, why: str) -> None:
        if self._has_run and not self._over:
            self._over = why
            self._exchange.set_row(None)
            log.warning("the run of %s is over: %s", self._program, why)


def describe_station(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the robot of a snapshot: names, units and limits of its numbers, cameras with height and width, rate."""
    facts, link = status["facts"], status["link"]
    return {
        "protocol": PROTOCOL,
        "station": status["station"],
        **{key: facts[key] for key in ("robot", "joint_names", "units", "lower", "upper", "gripper_dims")},
        **{key: facts[key] for key in ("rate", "tasks", "home", "velocity", "moves_robot")},
        "has_bench": facts["bench"] is not None,
        "lerobot": facts.get("lerobot"),
        "cameras": {camera: link["picture_sizes"].get(camera) for camera in facts["cameras"]},
        "state": status["state"],
    }
