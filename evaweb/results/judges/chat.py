"""Automatic judge behind an HTTP server with the OpenAI-compatible chat format.

The judge is sent the images of each trial once. Requests go only to the address in its set-up: redirects are not
followed and proxies are not used. Time and size of the answer are limited. An answer that does not have the requested
format is no verdict.
"""

from __future__ import annotations

import base64
import http.client
import json
import os
import re
import socket
import ssl
import threading
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from ipaddress import ip_address
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from evaweb.core.errors import EvaError
from evaweb.results.judges.base import (
    CaseJudgement,
    MilestoneJudgement,
    NoVerdict,
    Setup,
    StillImage,
    TrialCase,
)
from runtime.core.sentences import Pattern, fixed

_ADDRESS_PORT_0_ALLOWED_1 = Pattern(
    "results.judges.chat.address_port_0_allowed_1",
    "address = {given!r:.200}: port 0; allowed: 1 to 65535, or none for the usual one",
)
_ADDRESS_PICTURES_WOULD_TRAVEL_FOR = Pattern(
    "results.judges.chat.address_pictures_would_travel_for",
    "address = {given!r:.200}: pictures would travel for everybody to read; allowed: https, http on "
    "this machine, or http elsewhere where that is ticked",
)
_MODEL_EMPTY_NAME_ONE_ASKED = fixed(
    "results.judges.chat.model_empty_name_one_asked",
    "model is empty: name the one that is asked",
)
_KEY_VARIABLE_ALLOWED_NAME_ENVIRONMENT = Pattern(
    "results.judges.chat.key_variable_allowed_name_environment",
    "key_variable = {key_variable!r:.80}; allowed: the name of an environment variable that begins with"
    " EVA_JUDGE_, or none",
)
_VARIABLE_WORKER_ENVIRONMENT_NOT_SET = Pattern(
    "results.judges.chat.variable_worker_environment_not_set",
    "the variable {name} of the worker's environment is not set, or holds what is no key",
)
_MODEL_CONTAINS_WHAT_VARIABLE_HOLDS = Pattern(
    "results.judges.chat.model_contains_what_variable_holds",
    "model contains what the variable {name} holds: name the model without its key",
)

SEES: Literal["pictures", "truth"] = "pictures"
SERVED = True
LARGEST_ANSWER = 256 * 1024  # [bytes]
_CONNECT_S = 10.0
_KEY = re.compile(r"EVA_JUDGE_[A-Z0-9_]{1,60}")
_HOW = (
    "You look at still pictures of one run of a robot, and say of each milestone whether it was reached during the "
    "run. Each picture has its camera and its time after the start of the run before it. Judge by the pictures alone. "
    "Answer with one JSON object and nothing else: "
    '{"milestones": [{"number": 1, "verdict": "reached", "probability": 0.97}]}, with one entry for each milestone. '
    "A verdict is reached, not reached, or no verdict where the pictures do not show it. The probability is that the "
    "milestone was reached, from 0 to 1, and null with no verdict."
)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address of a judge's server."""

    secure: bool
    host: str
    port: int
    path: str


def endpoint_of(setup: Setup) -> Endpoint:
    """Return the endpoint of a set-up's address, with /chat/completions appended.

    Raises:
        EvaError: If the address is not allowed.
    """
    address = setup.address
    allowed = "allowed: https://HOST[:PORT]/PATH, such as https://judge.example.org/v1"
    try:
        parts = urlsplit(address)
        port, host = parts.port, parts.hostname or ""
    except ValueError as error:
        raise EvaError(f"address = {address!r:.200}: {error}; {allowed}") from None
    odd = parts.query or parts.fragment or parts.username is not None or parts.password is not None
    if parts.scheme not in ("http", "https") or odd or not re.fullmatch(r"[!-~]+", address) or not host:
        raise EvaError(f"address = {address!r:.200}; {allowed}")
    if port == 0:
        raise EvaError(_ADDRESS_PORT_0_ALLOWED_1(given=address))
    secure = parts.scheme == "https"
    if not (secure or setup.plain or _on_this_machine(host)):
        raise EvaError(_ADDRESS_PICTURES_WOULD_TRAVEL_FOR(given=address))
    return Endpoint(
        secure, host, port or (443 if secure else 80), f"{parts.path.rstrip('/')}/chat/completions"
    )


def _on_this_machine(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class _Line(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    number: int
    verdict: Literal["reached", "not reached", "no verdict"]
    probability: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] | None


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    milestones: list[_Line]


class _Message(BaseModel):
    content: str | None = None
    refusal: str | None = None


class _Choice(BaseModel):
    message: _Message
    finish_reason: str | None = None


class _Completion(BaseModel):
    choices: Annotated[list[_Choice], Field(min_length=1)]
    model: str | None = None


class ChatJudge:
    """Judge that sends one request per trial, with a time limit and a strict answer format."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._endpoint = endpoint_of(setup)
        if not setup.model.strip():
            raise EvaError(_MODEL_EMPTY_NAME_ONE_ASKED)
        if setup.key_variable and not _KEY.fullmatch(setup.key_variable):
            raise EvaError(_KEY_VARIABLE_ALLOWED_NAME_ENVIRONMENT(key_variable=setup.key_variable))

    @property
    def version(self) -> str:
        """Version of the judge, with the name of the model."""
        return f"chat 1, {self._setup.model}"

    def prompt_text(self, case: TrialCase) -> str:
        """Return the texts around the images."""
        return json.dumps([_HOW, _question(case)], ensure_ascii=False)

    def judge(self, case: TrialCase) -> CaseJudgement:
        """Return the server's judgement.

        Raises:
            NoVerdict: If there is no usable answer; with the reason.
            EvaError: If the key is not available.
        """
        key = self._key()
        content = self._post(json.dumps(_request(case, self._setup.model)).encode(), key)
        try:
            judgement = _read(content, len(case.steps))
        except NoVerdict as none:
            raise NoVerdict(_without(key, str(none))) from None
        return replace(judgement, model=_without(key, judgement.model))

    def _key(self) -> str:
        name = self._setup.key_variable
        if not name:
            return ""
        key = os.environ.get(name, "").strip()
        if not re.fullmatch(r"[!-~]{1,4096}", key):
            raise EvaError(_VARIABLE_WORKER_ENVIRONMENT_NOT_SET(name=name))
        if key in self._setup.model:  # the name is stored with every judgement
            raise EvaError(_MODEL_CONTAINS_WHAT_VARIABLE_HOLDS(name=name))
        return key

    def _post(self, body: bytes, key: str) -> bytes:
        at, wait = self._endpoint, self._setup.patience_s
        headers = {"Content-Type": "application/json", "Accept": "application/json", "Connection": "close"}
        headers |= {"Authorization": f"Bearer {key}"} if key else {}
        # Not urllib: it follows redirects, and uses the proxies of the environment.
        connection = (http.client.HTTPSConnection if at.secure else http.client.HTTPConnection)(
            at.host, at.port
        )
        with closing(connection), _Deadline(wait) as deadline:
            try:
                connection.sock = deadline.connected(at)
                connection.request("POST", at.path, body, headers)
                answer = connection.getresponse()
                content = answer.read(LARGEST_ANSWER + 1) if answer.status == 200 else b""
            except (OSError, http.client.HTTPException, UnicodeError) as error:
                raise NoVerdict(_no_answer(error, deadline)) from None
            if deadline.over:  # a truncated answer may look complete
                raise NoVerdict(_no_answer(TimeoutError(), deadline))
        if 300 <= answer.status < 400:
            raise NoVerdict(f"the server sends on to elsewhere (HTTP {answer.status}), which is not followed")
        if answer.status != 200:
            raise NoVerdict(f"the server answered HTTP {answer.status}")
        if len(content) > LARGEST_ANSWER:
            raise NoVerdict(f"the answer is longer than {LARGEST_ANSWER} bytes")
        return content


class _Deadline:
    """Deadline that shuts down a connection when it is over, whatever the connection is waiting for."""

    def __init__(self, wait: float) -> None:
        self.wait, self.over = wait, False
        self._socket: socket.socket | None = None
        self._timer = threading.Timer(wait, self._cut)
        self._timer.daemon = True

    def __enter__(self) -> _Deadline:
        self._timer.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._timer.cancel()
        if self._socket is not None:
            self._socket.close()

    def connected(self, at: Endpoint) -> socket.socket:
        """Return a connection to the endpoint `at`; a secure endpoint's certificate is verified.

        Raises:
            TimeoutError: If the deadline is over.
        """
        connection = socket.create_connection((at.host, at.port), min(self.wait, _CONNECT_S))
        connection.settimeout(self.wait)
        self._socket = connection
        if at.secure:
            context = ssl.create_default_context()
            connection = context.wrap_socket(
                connection, server_hostname=at.host, do_handshake_on_connect=False
            )
            self._socket = connection
            connection.do_handshake()
        if self.over:
            raise TimeoutError
        return connection

    def _cut(self) -> None:
        self.over = True
        if self._socket is not None:
            with suppress(OSError):
                socket.socket.shutdown(
                    self._socket, socket.SHUT_RDWR
                )  # not the shutdown of TLS, which would wait


def _no_answer(error: Exception, deadline: _Deadline) -> str:
    if deadline.over or isinstance(error, TimeoutError):
        return f"no answer within {deadline.wait:g} s"
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the server's certificate does not hold: {error.verify_message}"
    if isinstance(error, OSError):
        return f"the server cannot be reached: {error.strerror or type(error).__name__}"
    if isinstance(error, UnicodeError):
        return "the server's name is not a valid host name"
    return f"the server does not speak HTTP as is usual: {type(error).__name__}"


def _question(case: TrialCase) -> str:
    within = (f" (within {step.limit_s:g} s)" if step.limit_s is not None else "" for step in case.steps)
    lines = [
        f"{n}. {step.text}{limit}" for n, (step, limit) in enumerate(zip(case.steps, within, strict=True), 1)
    ]
    success = [f"Success: {case.criterion}"] if case.criterion else []
    return "\n".join([f"The robot was told: {case.instruction}", *success, "Milestones:", *lines])


def _request(case: TrialCase, model: str) -> dict[str, Any]:
    pictures = [part for still in case.stills for part in _parts(still)]
    return {
        "model": model,
        "temperature": 0,
        "response_format": {"type": "json_object"},
        "messages": [
            {"role": "system", "content": _HOW},
            {"role": "user", "content": [{"type": "text", "text": _question(case)}, *pictures]},
        ],
    }


def _parts(still: StillImage) -> list[dict[str, Any]]:
    url = f"data:image/jpeg;base64,{base64.b64encode(still.jpeg).decode()}"
    return [
        {"type": "text", "text": f"{still.camera}, {still.at:.1f} s"},
        {"type": "image_url", "image_url": {"url": url}},
    ]


def _read(content: bytes, n: int) -> CaseJudgement:
    """Return the judgement of `n` milestones from a server's answer.

    Raises:
        NoVerdict: If it is not exactly in the requested format.
    """
    try:
        completion = _Completion.model_validate_json(content)
    except ValidationError as error:
        raise NoVerdict(f"the answer is not a completion: {_wrong(error)}") from None
    choice = completion.choices[0]
    if choice.message.refusal or choice.finish_reason == "content_filter":
        raise NoVerdict(f"it refused: {choice.message.refusal or 'its filter of contents did'}")
    if choice.finish_reason not in (None, "stop"):
        raise NoVerdict(
            f"the answer is incomplete: finish_reason = '{choice.finish_reason}'"
        )  # whole: it may have the key
    try:
        lines = _Answer.model_validate_json(choice.message.content or "").milestones
    except ValidationError as error:
        raise NoVerdict(f"the answer is not in the requested form: {_wrong(error)}") from None
    numbers = sorted(line.number for line in lines)
    if numbers != list(range(1, n + 1)):
        raise NoVerdict(f"it spoke of the milestones {numbers!r:.60}; asked were 1 to {n}")
    return CaseJudgement(
        tuple(_said(line) for line in sorted(lines, key=lambda line: line.number)),
        completion.model or "",
    )


def _without(key: str, text: str) -> str:
    """Return the text without the key: some servers quote it in their answers."""
    return text.replace(key, "...") if key else text


def _said(line: _Line) -> MilestoneJudgement:
    reached = {"reached": True, "not reached": False, "no verdict": None}[line.verdict]
    try:
        return MilestoneJudgement(reached, line.probability)
    except ValueError as error:
        raise NoVerdict(f"milestone {line.number}: {error}") from None


def _wrong(error: ValidationError) -> str:
    """Return the first validation error, without the invalid input."""
    first = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(map(str, first["loc"]))
    return f"{place}: {first['msg']}" if place else str(first["msg"])


def build(setup: Setup) -> ChatJudge:
    """Return the judge.

    Raises:
        EvaError: If address, model or name of the key variable is invalid.
    """
    return ChatJudge(setup)
