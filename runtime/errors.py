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


class PolicyLostError(PolicyError):
    """The policy server is not there any more, or did not answer in time; it may come back."""


class TransportError(RuntimeFault):
    """The execution node or the dataset is absent, gone, or sent something unusable."""


class CodecError(RuntimeFault):
    """Bytes from a peer do not follow the wire format that was expected of them."""


class RecordingError(RuntimeFault):
    """An episode cannot be written, read or published; names the file and the reason."""
