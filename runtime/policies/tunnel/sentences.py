"""Messages of an ssh that ends, as one sentence, and advice about it."""

from __future__ import annotations

import re
from collections.abc import Sequence

_OWN_FAULT = 255  # of ssh; any other code is that of what was run at the far end
_SIGNALS = range(-64, 0)
_OVER = "what is run there, cat, ended; for an account that may run nothing set policy.tunnel.session = false"
_TAKEN = re.compile(r"Address already in use|cannot listen to port")
_ADVICE = (
    (
        r"Permission denied",
        "correct policy.tunnel.user or identity_file; nobody is asked for a passphrase, so a key that has one has to "
        "be in the agent of whoever starts the station",
    ),
    (
        r"has changed and you have requested|REMOTE HOST IDENTIFICATION",
        "ask who runs that host before its old key is taken out of the known hosts",
    ),
    (
        r"Host key verification failed|host key is known",
        "compare its fingerprint with whoever runs it and add it to the known hosts (ssh to it once by hand), or set "
        'policy.tunnel.host_keys = "accept-new"',
    ),
    (
        r"resolve hostname|Connection refused|timed out|No route|unreachable",
        "correct policy.tunnel.host or port, or see that the host is up",
    ),
)


def port_was_taken(said: Sequence[str]) -> bool:
    """True if another process was quicker to take the near end's port."""
    return any(_TAKEN.search(line) for line in said)


def explain_exit(said: Sequence[str], code: int) -> str:
    """The last of what ssh said, with what came before it where that alone says little, and an advice."""
    told = "; ".join(list(said)[-2:]) or f"ssh ended with {code} and said nothing"
    if code not in (_OWN_FAULT, *_SIGNALS):
        return f"{told}: {_OVER}"
    return next((f"{told}: {advice}" for pattern, advice in _ADVICE if re.search(pattern, told)), told)


def explain_session_refused(refusal: str) -> str:
    """Why an ssh ended that was never up and said nothing but that the far end did not open its session."""
    return (
        f"no session was opened there ({refusal}): for an account or a server without any set "
        "policy.tunnel.session = false"
    )


def explain_forward_refused(refusal: str) -> str:
    """Advice for a connection that the far end did not make."""
    if "prohibited" in refusal:
        return "let the SSH server there forward to it (AllowTcpForwarding, PermitOpen)"
    return "start the policy server there, or correct policy.url, which is as seen from there"
