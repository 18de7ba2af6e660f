"""Ends of a preflight: how far it came, what it found, what to do about it."""

from __future__ import annotations

from enum import StrEnum

from runtime.core.errors import (
    ActionSpaceError,
    ConfigurationError,
    ContradictionError,
    NotFiniteError,
    PolicyLostError,
    PolicyTimeout,
    PortClosedError,
    RefusedError,
    RuntimeFault,
    ServerSaysError,
    SetupError,
    ShapeError,
    TlsError,
    TunnelError,
    UnreachableError,
    WrongProtocolError,
)


class Stage(StrEnum):
    """Stages of a preflight, in this order."""

    RESOLVE = "resolve"  # the deployment, and that its policy fits its robot
    CONNECT = "connect"  # somebody listens, with TLS where the address says so
    PROTOCOL = "protocol"  # who answers there speaks the protocol, and lets us in
    METADATA = "metadata"  # what the server says of itself agrees with the deployment
    INFER = "infer"  # it answers
    SHAPE = "shape"  # with rows of the right width, all finite
    SPACE = "space"  # that become commands for this robot


class Verdict(StrEnum):
    """Finding of a preflight."""

    OK = "ok"
    MISCONFIGURED = "misconfigured"
    PORT_CLOSED = "port_closed"
    UNREACHABLE = "unreachable"
    TUNNEL = "tunnel"
    TLS = "tls"
    WRONG_PROTOCOL = "wrong_protocol"
    TIMEOUT = "timeout"
    REFUSED = "refused"
    SERVER_ERROR = "server_error"
    BAD_SHAPE = "bad_shape"
    WRONG_ACTION_SPACE = "wrong_action_space"
    NOT_FINITE = "not_finite"
    CONTRADICTION = "contradiction"
    FAILED = "failed"

    @property
    def advice(self) -> str:
        """Next step in one sentence; "" where nothing is to be done."""
        return _ADVICE[self]


_ADVICE = {
    Verdict.OK: "",
    Verdict.MISCONFIGURED: "Correct the deployment, or the checkpoint's policy table; no server was asked.",
    Verdict.PORT_CLOSED: "The machine is there and nothing listens: start the policy server, or correct the port.",
    Verdict.UNREACHABLE: "Correct the host's name, switch the machine on, or open the network on the way to it.",
    Verdict.TUNNEL: "The SSH tunnel does not stand: try the same host with ssh in a terminal, without a password.",
    Verdict.TLS: "Use ws:// for a server without TLS, else correct its certificate.",
    Verdict.WRONG_PROTOCOL: "Another server listens there, or policy.kind is wrong: compare both.",
    Verdict.TIMEOUT: "See whether the server is busy, still loading or stuck; a slow model needs longer deadlines.",
    Verdict.REFUSED: "Give the key or token that the server wants to this machine's environment, by the name in the "
    "policy table.",
    Verdict.SERVER_ERROR: "The server is there and fails: its own log says why; if it has no word of us, it is "
    "a server of another kind.",
    Verdict.BAD_SHAPE: "The checkpoint behind the server is for another robot, or the policy table lays its rows out "
    "wrongly.",
    Verdict.WRONG_ACTION_SPACE: "The checkpoint's actions are of another space than the policy table says: correct "
    "the table, never guess.",
    Verdict.NOT_FINITE: "The model computes what is no number: look at its checkpoint and its normalisation.",
    Verdict.CONTRADICTION: "Server and deployment say different things: correct the one that is wrong.",
    Verdict.FAILED: "Read the sentence; it is none of the usual cases.",
}

# The first that fits; a subclass stands before its base.
_FOUND: tuple[tuple[type[RuntimeFault], Verdict], ...] = (
    (PortClosedError, Verdict.PORT_CLOSED),
    (UnreachableError, Verdict.UNREACHABLE),
    (TunnelError, Verdict.TUNNEL),
    (TlsError, Verdict.TLS),
    (WrongProtocolError, Verdict.WRONG_PROTOCOL),
    (RefusedError, Verdict.REFUSED),
    (PolicyTimeout, Verdict.TIMEOUT),
    (ServerSaysError, Verdict.SERVER_ERROR),
    (PolicyLostError, Verdict.SERVER_ERROR),
    (ShapeError, Verdict.BAD_SHAPE),
    (NotFiniteError, Verdict.NOT_FINITE),
    (ActionSpaceError, Verdict.WRONG_ACTION_SPACE),
    (ContradictionError, Verdict.CONTRADICTION),
    (ConfigurationError, Verdict.MISCONFIGURED),
    (SetupError, Verdict.CONTRADICTION),
)
_ON_THE_WAY = (Verdict.PORT_CLOSED, Verdict.UNREACHABLE, Verdict.TUNNEL, Verdict.TLS)
_OF_THE_ROWS = (Verdict.BAD_SHAPE, Verdict.NOT_FINITE)
_OF_WORDS = (Verdict.WRONG_ACTION_SPACE, Verdict.CONTRADICTION)


def verdict_of(error: RuntimeFault) -> Verdict:
    """Verdict on an error of a policy, of its set-up or of its configuration."""
    return next((verdict for kind, verdict in _FOUND if isinstance(error, kind)), Verdict.FAILED)


def stage_of(verdict: Verdict, call: str) -> Stage:
    """Stage of that verdict; `call` is the policy's call that was under way, "" after the last of them."""
    if verdict is Verdict.MISCONFIGURED:
        return Stage.RESOLVE
    if call == "connect":
        if verdict in _ON_THE_WAY:
            return Stage.CONNECT
        return Stage.METADATA if verdict in _OF_WORDS else Stage.PROTOCOL
    if verdict in _OF_THE_ROWS:
        return Stage.SHAPE
    if verdict in _OF_WORDS or not call:
        return Stage.SPACE
    return Stage.INFER
