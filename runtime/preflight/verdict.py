"""Results of a preflight: stage, verdict and advice."""

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
    ServerReportedError,
    SetupError,
    ShapeError,
    TlsError,
    TunnelError,
    UnreachableError,
    WrongProtocolError,
)


class PreflightStage(StrEnum):
    """Stages of a preflight, in this order."""

    RESOLVE = "resolve"  # deployment is valid and its policy fits its robot
    CONNECT = "connect"  # a server listens, with TLS if the address demands it
    PROTOCOL = "protocol"  # the server speaks the protocol and accepts us
    METADATA = "metadata"  # the server's metadata agree with the deployment
    INFER = "infer"  # the server responds to a request
    SHAPE = "shape"  # rows have the right width and are finite
    SPACE = "space"  # rows can be converted to commands for this robot


class PreflightVerdict(StrEnum):
    """Result of a preflight."""

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
        """Next step in one sentence; "" if none is needed."""
        return _ADVICE[self]


_ADVICE = {
    PreflightVerdict.OK: "",
    PreflightVerdict.MISCONFIGURED: "Correct the deployment, or the checkpoint's policy table; no server was asked.",
    PreflightVerdict.PORT_CLOSED: "The machine is there and nothing listens: start the policy server, or correct the "
    "port.",
    PreflightVerdict.UNREACHABLE: "Correct the host's name, switch the machine on, or open the network on the way to "
    "it.",
    PreflightVerdict.TUNNEL: "The SSH tunnel does not stand: try the same host with ssh in a terminal, without a "
    "password.",
    PreflightVerdict.TLS: "Use ws:// for a server without TLS, else correct its certificate.",
    PreflightVerdict.WRONG_PROTOCOL: "Another server listens there, or policy.kind is wrong: compare both.",
    PreflightVerdict.TIMEOUT: "See whether the server is busy, still loading or stuck; a slow model needs longer "
    "deadlines.",
    PreflightVerdict.REFUSED: "Give the key or token that the server wants to this machine's environment, by the "
    "name in the "
    ""
    "policy table.",
    PreflightVerdict.SERVER_ERROR: "The server is there and fails: its own log says why; if it has no word of us, "
    ""
    ""
    "it is a server of another kind.",
    PreflightVerdict.BAD_SHAPE: "The checkpoint behind the server is for another robot, or the policy table lays its "
    "rows out "
    ""
    "wrongly.",
    PreflightVerdict.WRONG_ACTION_SPACE: "The checkpoint's actions are of another space than the policy table says: "
    ""
    ""
    "correct the table, never guess.",
    PreflightVerdict.NOT_FINITE: "The model computes what is no number: look at its checkpoint and its normalisation.",
    PreflightVerdict.CONTRADICTION: "Server and deployment say different things: correct the one that is wrong.",
    PreflightVerdict.FAILED: "Read the sentence; this is not one of the usual cases.",
}

# The first match counts, so subclasses precede their base.
_FOUND: tuple[tuple[type[RuntimeFault], PreflightVerdict], ...] = (
    (PortClosedError, PreflightVerdict.PORT_CLOSED),
    (UnreachableError, PreflightVerdict.UNREACHABLE),
    (TunnelError, PreflightVerdict.TUNNEL),
    (TlsError, PreflightVerdict.TLS),
    (WrongProtocolError, PreflightVerdict.WRONG_PROTOCOL),
    (RefusedError, PreflightVerdict.REFUSED),
    (PolicyTimeout, PreflightVerdict.TIMEOUT),
    (ServerReportedError, PreflightVerdict.SERVER_ERROR),
    (PolicyLostError, PreflightVerdict.SERVER_ERROR),
    (ShapeError, PreflightVerdict.BAD_SHAPE),
    (NotFiniteError, PreflightVerdict.NOT_FINITE),
    (ActionSpaceError, PreflightVerdict.WRONG_ACTION_SPACE),
    (ContradictionError, PreflightVerdict.CONTRADICTION),
    (ConfigurationError, PreflightVerdict.MISCONFIGURED),
    (SetupError, PreflightVerdict.CONTRADICTION),
)
_ON_THE_WAY = (
    PreflightVerdict.PORT_CLOSED,
    PreflightVerdict.UNREACHABLE,
    PreflightVerdict.TUNNEL,
    PreflightVerdict.TLS,
)
_OF_THE_ROWS = (PreflightVerdict.BAD_SHAPE, PreflightVerdict.NOT_FINITE)
_OF_WORDS = (PreflightVerdict.WRONG_ACTION_SPACE, PreflightVerdict.CONTRADICTION)


def verdict_of(error: RuntimeFault) -> PreflightVerdict:
    """Return the verdict on an error of a policy, a set-up or a configuration."""
    return next((verdict for kind, verdict in _FOUND if isinstance(error, kind)), PreflightVerdict.FAILED)


def stage_of(verdict: PreflightVerdict, call: str) -> PreflightStage:
    """Return the stage to which a verdict belongs; `call` is the policy's present call, "" after the last one."""
    if verdict is PreflightVerdict.MISCONFIGURED:
        return PreflightStage.RESOLVE
    if call == "connect":
        if verdict in _ON_THE_WAY:
            return PreflightStage.CONNECT
        return PreflightStage.METADATA if verdict in _OF_WORDS else PreflightStage.PROTOCOL
    if verdict in _OF_THE_ROWS:
        return PreflightStage.SHAPE
    if verdict in _OF_WORDS or not call:
        return PreflightStage.SPACE
    return PreflightStage.INFER
