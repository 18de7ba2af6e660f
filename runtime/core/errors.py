"""Errors of the runtime, with one base; each message names the offender and what is allowed."""


class RuntimeFault(Exception):
    """Error for a person to read: the message states what is wrong and what to do."""


class ConfigurationError(RuntimeFault):
    """Error in a deployment file, robot description or option; names file, key, value and allowed values."""


class SetupError(RuntimeFault):
    """Error that a component cannot do what the deployment requires; detected before anything moves."""


class PolicyError(RuntimeFault):
    """Error that the policy server is absent, silent or gone, or that its response is unusable."""


class ContradictionError(SetupError, PolicyError):
    """Error that the policy server's own description contradicts the deployment; the message names both."""


class ActionSpaceError(ContradictionError):
    """Error that the server's actions have another space, format or width than the deployment declares."""


class WrongProtocolError(PolicyError):
    """Error that the server at the policy's address does not speak the declared protocol."""


class RefusedError(PolicyError):
    """Error that the policy server requires a key or token that is missing or wrong."""


class TlsError(PolicyError):
    """Error that there is no encrypted connection: the policy server has no TLS, or an untrusted certificate."""


class ServerReportedError(PolicyError):
    """Error that the policy server itself reports in its response."""


class ShapeError(PolicyError):
    """Error that the rows of a response have another shape than the robot needs."""


class NotFiniteError(PolicyError):
    """Error that the rows of a response contain numbers that are not finite."""


class PolicyLostError(PolicyError):
    """Error that the policy server disappeared or did not respond in time; it may come back."""


class PolicyTimeout(PolicyLostError):
    """Error that the server did not respond within the deadline; the connection is closed."""


class PolicyDisconnected(PolicyLostError):
    """Error that the server closed the connection; it may have restarted."""


class UnsolicitedError(PolicyLostError):
    """Error that the server sent a response without a request; the connection is closed.

    Otherwise each later response could be matched to the wrong request.
    """


class PortClosedError(PolicyLostError):
    """Error that the policy server's machine responds, but its port is closed."""


class UnreachableError(PolicyLostError):
    """Error that the policy server's machine is unreachable: unknown host name, or no route."""


class TunnelError(PolicyLostError):
    """Error that the SSH tunnel to the policy server is down; the message has the reason."""


class TransportError(RuntimeFault):
    """Error that the execution node or dataset is absent or gone, or sent unusable data."""


class CodecError(RuntimeFault):
    """Error that bytes from a peer do not follow the expected wire format."""


class RecordingError(RuntimeFault):
    """Error that an episode cannot be written, read or published; names the file and the reason."""
