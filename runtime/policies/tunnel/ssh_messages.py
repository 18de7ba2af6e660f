"""Explanations of why ssh ended, each as one sentence with advice."""

from __future__ import annotations

import re
from collections.abc import Sequence

_OWN_FAULT = 255  # exit code of ssh's own errors; others come from the remote command
_SIGNALS = range(-64, 0)
_OVER = "what is run there, cat, ended; for an account that may run nothing set policy.tunnel.session = false"
_TAKEN = re.compile(r"Address already in use|cannot listen to port")
_ADVICE = (
    (
        r"Permission denied",
        "correct policy.tunnel.user or identity_file; a passphrase is never asked for, "
        "so a key that has one has to be in the agent of the user who starts the station",
    ),
    (
        r"has changed and you have requested|REMOTE HOST IDENTIFICATION",
        "ask who runs that host before its old key is taken out of the known hosts",
    ),
    (
        r"Host key verification failed|host key is known",
        "compare its fingerprint with its administrator and add it to the known hosts (ssh to it once by hand), or set "
        'policy.tunnel.host_keys = "accept-new"',
    ),
    (
        r"resolve hostname|Connection refused|timed out|No route|unreachable",
        "correct policy.tunnel.host or port, or see that the host is up",
    ),
)


def port_was_taken(said: Sequence[str]) -> bool:
    """Return True if ssh reports that another process took its local port first."""
    return any(_TAKEN.search(line) for line in said)


def explain_exit(said: Sequence[str], code: int) -> str:
    """Return the last two lines of ssh's output, with advice if a known cause matches them."""
    text = "; ".join(list(said)[-2:]) or f"ssh exited with {code} and no output"
    if code not in (_OWN_FAULT, *_SIGNALS):
        return f"{text}: {_OVER}"
    return next((f"{text}: {advice}" for pattern, advice in _ADVICE if re.search(pattern, text)), text)


def explain_session_refused(refusal: str) -> str:
    """Return the reason with advice if the tunnel never came up because the far end refused a session."""
    return (
        f"no session was opened there ({refusal}): for an account or a server without any set "
        "policy.tunnel.session = false"
    )


def explain_forward_refused(refusal: str) -> str:
    """Return advice for a connection that the far end refused."""
    if "prohibited" in refusal:
        return "let the SSH server there forward to it (AllowTcpForwarding, PermitOpen)"
    return "start the policy server there, or correct policy.url, which is as seen from there"
