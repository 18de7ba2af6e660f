"""Errors of the runtime, with one base; each message names the offender and what is allowed."""


class RuntimeFault(Exception):
    """Error for a person to read: the message states what is wrong and what to do."""


class ConfigurationError(RuntimeFault):
    """Error in a deployment file, robot description or option; names file, key, value and allowed values."""


class SetupError(RuntimeFault):
    """A component cannot do what the deployment requires; detected before anything moves."""


class PolicyError(RuntimeFault):
    """The policy server is absent, silent or gone, or its response is unusable."""


class ContradictionError(SetupError, PolicyError):
    """The policy server's own description contradicts the deployment; the message names both sides."""


class ActionSpaceError(ContradictionError):
    """The server's actions have another space, format or width than the deployment declares."""


class WrongProtocolError(PolicyError):
    """The server at the policy's address does not speak the declared protocol."""


class RefusedError(PolicyError):
    """The policy server requires a key or token that is missing or wrong."""


class TlsError(PolicyError):
    """No encrypted connection to the policy server: it has no TLS, or its certificate is not trusted."""


class ServerReportedError(PolicyError):
    """The policy server responds and reports a failure."""


class ShapeError(PolicyError):
    """The rows of a response have another shape than the robot needs."""


class NotFiniteError(PolicyError):
    """The rows of a response contain numbers that are not finite."""


class PolicyLostError(PolicyError):
    """The policy server disappeared or did not respond in time; it may come back."""


class PolicyTimeout(PolicyLostError):
    """The server did not respond within the deadline; the connection is closed."""


class PolicyDisconnected(PolicyLostError):
    """The server closed the connection; it may have restarted."""


class UnsolicitedError(PolicyLostError):
    """The server sent a response without a request, so responses may be off by one; the connection is closed."""


class PortClosedError(PolicyLostError):
    """The policy server's machine responds, but its port is closed."""


class UnreachableError(PolicyLostError):
    """The policy server's machine is unreachable: unknown host name, or no route."""


class TunnelError(PolicyLostError):
    """The SSH tunnel to the policy server is down; the message has the reason."""


class TransportError(RuntimeFault):
    """The execution node or dataset is absent or gone, or sent something unusable."""


class CodecError(RuntimeFault):
    """Bytes from a peer do not follow the expected wire format."""


class RecordingError(RuntimeFault):
    """An episode cannot be written, read or published; names the file and the reason."""
