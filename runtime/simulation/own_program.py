"""Bench that a program of its own simulates, in a process with a Python environment of its own.

The process answers one request after the other over a Unix socket (`runtime.benches.host`). The bench advances by one
step for each row of a policy or leader, and by nothing else: without rows its time stands still. Row, state and
observation vector pass as they are.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import tempfile
import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq

from runtime.benches.environments import program_variables, require_python
from runtime.benches.schema import bench_folder, load_schema
from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError, SetupError
from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.environment import Environment

if TYPE_CHECKING:
    from robots import Robot

PROTOCOL = 1
START_S = 120.0  # for imports and the first reset of a program
ANSWER_S = 60.0
_POLL_S = 0.2
_TOLD = 500  # numbers of an observation vector that the ground truth repeats, for the record
_LAST_LINES = 30  # of a program's output, for the error if it ends
_LONGEST_LINE = 2000  # characters; the rest of a line counts as another
_HOST = "runtime.benches.host"


class ProgramEnvironment(Environment):
    """Environment whose bench is simulated by a program of its own; `close` ends the program.

    Raises:
        SetupError: If the bench's environment is not installed, or the program does not start or fit the robot.
    """

    def __init__(self, robot: Robot, options: argparse.Namespace) -> None:
        self._schema = load_schema(options.bench)
        program = self._schema.program
        assert program is not None, options.bench
        self._robot = robot
        self._size = {"width": options.width, "height": options.height}
        self._process = ProgramProcess(options.bench)
        try:
            hello = self._process.request("describe")
            self._require_fit(hello)
            self._reset = ResetRequest("", options.seed)
            self._moment = self._moment_of(
                self._process.request("reset", **self._reset_arguments(self._reset))
            )
        except BaseException:
            self.close()
            raise
        self._drawn: dict[str, UInt8] = {}

    def move(self, plant: Plant, seconds: float) -> None:
        """Advance by one step if the plant has a new row, which is passed on as float32; otherwise nothing moves."""
        row, plant.row = plant.row, None
        if row is not None and not self._moment["over"]:
            answer = self._process.request("step", row=row.astype(np.float32))
            self._moment, self._drawn = self._moment_of(answer), {}
        plant.q = self._moment["state"].astype(np.float64)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return the images of the present state, which are drawn once."""
        if not self._drawn:
            answer = self._process.request("observe", **self._size)
            self._drawn = self._pictures_of(answer)
        return dict(self._drawn)

    def state_vector(self) -> Float64 | None:
        """Return the benchmark's own observation vector; None if it has none."""
        vector: Float64 | None = self._moment["observation"]
        return vector

    def truth(self) -> dict[str, object]:
        """Return what the program reports: milestones, success, and why it is over."""
        choices, vector = dict(self._reset.choices or {}), self._moment["observation"]
        told = vector is not None and len(vector) <= _TOLD
        return {
            "reset": self._reset.id,
            "seed": self._reset.seed,
            **({"choices": choices} if choices else {}),
            **({"observation": vector.tolist()} if told else {}),
            "steps": self._moment["steps"],
            "milestones": dict(self._moment["milestones"]),
            "success": all(self._moment["milestones"][name] for name in self._schema.success),
            "over": self._moment["over"],
        }

    def reset(self, wish: ResetRequest) -> None:
        """Reset the bench as requested; if `wish` has the id of the last reset, do nothing."""
        if wish.id == self._reset.id:
            return
        if problem := next(self._schema.choice_problems(wish.choices or {}), ""):
            raise BenchError(problem)
        if wish.positions or wish.factors:
            raise BenchError(
                f"positions or factors of {self._schema.title!r}, which has none; allowed: choices"
            )
        self._moment = self._moment_of(self._process.request("reset", **self._reset_arguments(wish)))
        self._reset, self._drawn = wish, {}

    def close(self) -> None:
        """End the program."""
        self._process.close()

    def _reset_arguments(self, wish: ResetRequest) -> dict[str, Any]:
        usual = {name: choice.usual for name, choice in self._schema.choices.items()}
        return {"seed": wish.seed, "choices": {**usual, **(wish.choices or {})}}

    def _require_fit(self, hello: dict[str, Any]) -> None:
        """Raise SetupError unless the program speaks this protocol and has the robot's numbers and cameras."""
        program = self._schema.program
        assert program is not None
        wanted = {
            "protocol": PROTOCOL,
            "dim": self._robot.dim,
            "observation": program.observation,
            "milestones": sorted(self._schema.milestones),
            "cameras": sorted(camera.key for camera in self._robot.cameras),
        }
        for key, expected in wanted.items():
            given = hello.get(key)
            given = (
                sorted(given, key=str) if isinstance(expected, list) and isinstance(given, list) else given
            )
            if given != expected:
                raise SetupError(
                    f"the program of the bench {self._schema.title!r} has {key} = {given!r}; expected: {expected!r}, "
                    f"as bench.toml and the robot {self._robot.name} declare"
                )

    def _moment_of(self, answer: dict[str, Any]) -> dict[str, Any]:
        """Return a state of the bench after checking it: `state` float32 [D], `observation` float64 [V] or None."""
        program = self._schema.program
        assert program is not None
        state = _vector(answer, "state", np.float32, self._robot.dim)
        observation = (
            _vector(answer, "observation", np.float64, program.observation) if program.observation else None
        )
        milestones, over, steps = answer.get("milestones"), answer.get("over"), answer.get("steps")
        named = isinstance(milestones, dict) and set(milestones) == set(self._schema.milestones)
        if not named or not all(isinstance(value, bool) for value in milestones.values()):  # type: ignore[union-attr]
            raise SetupError(
                f"the bench's program reports milestones {milestones!r:.200}; expected true or false for each of "
                f"{', '.join(self._schema.milestones)}"
            )
        if not isinstance(over, str) or type(steps) is not int:
            raise SetupError(f"the bench's program reports over = {over!r:.80}, steps = {steps!r:.20}")
        return {
            "state": state,
            "observation": observation,
            "milestones": milestones,
            "over": over,
            "steps": steps,
        }

    def _pictures_of(self, answer: dict[str, Any]) -> dict[str, UInt8]:
        shape = (self._size["height"], self._size["width"], 3)
        pictures = {}
        for camera in self._robot.cameras:
            picture = answer.get("pictures", {}).get(camera.key)
            if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.shape != shape:
                kind = getattr(picture, "shape", type(picture).__name__)
                raise SetupError(
                    f"the bench's program gives a picture {camera.key} of {kind}; expected uint8 {list(shape)}"
                )
            pictures[camera.key] = picture[..., ::-1]  # RGB -> BGR
        return pictures


class ProgramProcess:
    """Process of a bench's program; `request` sends a request and waits for its answer.

    Raises:
        SetupError: If the bench's environment is not installed, or the program cannot be started.
    """

    def __init__(self, bench: str) -> None:
        folder = bench_folder(bench).resolve()
        program = load_schema(bench).program
        assert program is not None, bench
        python = require_python(bench)
        self._folder = Path(tempfile.mkdtemp(prefix="eva-bench-"))
        self._lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._socket: zmq.Socket[bytes] | None = None
        self._process: subprocess.Popen[str] | None = None
        self._output: threading.Thread | None = None
        self._address = f"ipc://{self._folder}/bench"
        try:
            self._process = subprocess.Popen(
                [str(python), "-m", _HOST, str(folder / program.file), self._address],
                cwd=self._folder,
                env=program_variables(bench),
                stdin=subprocess.PIPE,  # its end ends the program, however this process ends
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
            self._output = threading.Thread(target=self._read_output, name="bench-output", daemon=True)
            self._output.start()
            self._socket = zmq.Context.instance().socket(zmq.REQ)
            self._socket.setsockopt(zmq.LINGER, 0)
            self._socket.connect(self._address)
            self.request("ready", patience=START_S)
        except (OSError, zmq.ZMQError) as error:
            self.close()
            raise SetupError(f"the program of the bench {bench} cannot be started: {error}") from error
        except BaseException:
            self.close()
            raise

    def request(self, word: str, patience: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
        """Return the answer to a request.

        Raises:
            BenchError: If the program refuses it.
            SetupError: If the program has ended, is silent, or its answer cannot be read.
        """
        assert self._socket is not None, "the process is closed"
        self._socket.send(msgpack_arrays.pack({"do": word, **arguments}))
        waited = 0.0
        while not self._socket.poll(round(1000 * _POLL_S)):
            waited += _POLL_S
            if self._process is None or self._process.poll() is not None:
                raise SetupError(f"the bench's program has ended: {self._last_output()}")
            if waited > patience:
                raise SetupError(f"the bench's program has not answered {word!r} for {patience:g} s")
        try:
            answer = msgpack_arrays.unpack(self._socket.recv())
        except CodecError as error:
            raise SetupError(f"the bench's program: {error}") from error
        if not isinstance(answer, dict):
            raise SetupError(f"the bench's program answers {type(answer).__name__}; expected a map")
        if "error" in answer:
            raise BenchError(f"the bench's program: {answer['error']}")
        return answer

    def close(self) -> None:
        """End the program and remove its folder; safe to call twice."""
        socket, self._socket = self._socket, None
        process, self._process = self._process, None
        if socket is not None:
            socket.close()
        if process is not None:
            assert process.stdin is not None
            with contextlib.suppress(OSError):
                process.stdin.close()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _read_output(self) -> None:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        while line := process.stdout.readline(_LONGEST_LINE):
            self._lines.append(line.rstrip())

    def _last_output(self) -> str:
        if self._output is not None:
            self._output.join(1.0)  # what it said at its end may not have been read yet
        return " / ".join(self._lines) or "it said nothing"


def _vector(answer: dict[str, Any], key: str, kind: type[np.generic], width: int) -> Float32 | Float64:
    value = answer.get(key)
    fits = isinstance(value, np.ndarray) and value.dtype == kind and value.shape == (width,)
    if not fits or not np.isfinite(value).all():  # type: ignore[arg-type]
        given = (
            f"{value.dtype} {list(value.shape)}" if isinstance(value, np.ndarray) else type(value).__name__
        )
        raise SetupError(
            f"the bench's program gives {key} of {given}; expected {width} finite numbers, {kind.__name__}"
        )
    return value  # type: ignore[return-value]
