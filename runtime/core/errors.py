"""One base for every error of the runtime: a sentence that names the offender and what is allowed."""


class RuntimeFault(Exception):
    """Something that a person has to read: the message says what is wrong and what to do."""


class ConfigurationError(RuntimeFault):
    """A deployment file, a robot description or an option is wrong; names file, key, value, allowed."""


class SetupError(RuntimeFault):
    """A part cannot do what the deployment asks of it; found before anything moves."""


class PolicyError(RuntimeFault):
    """The policy server is absent, mute, gone, or answered with something unusable."""


class ContradictionError(SetupError, PolicyError):
    """The policy server says of itself what the deployment says otherwise; names both sides."""


class ActionSpaceError(ContradictionError):
    """The server's actions are of another space, form or width than the deployment says."""


class WrongProtocolError(PolicyError):
    """The server at the policy's address does not speak the protocol that the deployment says."""


class RefusedError(PolicyError):
    """The policy server wants a key or a token, and was given none, or a wrong one."""


class TlsError(PolicyError):
    """There is no encrypted connection to the policy server: no TLS, or a certificate that is not trusted."""


class ServerReportedError(PolicyError):
    """The policy server answers, and says that it failed."""


class ShapeError(PolicyError):
    """The rows of an answer have another shape than this robot needs."""


class NotFiniteError(PolicyError):
    """The rows of an answer have numbers that are not finite."""


class PolicyLostError(PolicyError):
    """The policy server is not there any more, or did not answer in time; it may come back."""


class PolicyTimeout(PolicyLostError):
    """The server did not answer within the deadline; the connection is dropped."""


class PolicyDisconnected(PolicyLostError):
    """The server closed the connection; it may have restarted."""


class UnsolicitedError(PolicyLostError):
    """The server sent what nobody had asked for, so answers may be off by one; the connection is dropped."""


class PortClosedError(PolicyLostError):
    """The policy server's machine answers, and nobody listens at the port."""


class UnreachableError(PolicyLostError):
    """The policy server's machine cannot be reached: its name is not known, or no way leads there."""


class TunnelError(PolicyLostError):
    """There is no SSH tunnel to the policy server at the moment; says why."""


class TransportError(RuntimeFault):
    """The execution node or the dataset is absent, gone, or sent something unusable."""


class CodecError(RuntimeFault):
    """Bytes from a peer do not follow the wire format that was expected of them."""


class RecordingError(RuntimeFault):
    """An episode cannot be written, read or published; names the file and the reason."""
