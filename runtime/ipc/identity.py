"""Identity of a command's sender: a user signed by the web, a local account, or unverified.

A command's own claims are never trusted. The web signs the whole message, so that user and role are valid for this
command only.
"""

from __future__ import annotations

import hmac
import os
import secrets
import stat
from dataclasses import replace
from pathlib import Path

from runtime.core.durable_files import create_durably
from runtime.core.errors import ConfigurationError
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.endpoints import account_name
from runtime.ipc.messages import Command

_NEEDS_OPERATOR = Pattern("rights.needs_operator", "{kind} needs an operator; {user} is {role}")
_WITHOUT_ROLE = fixed("rights.without_role", "signed for without a role")
_FORGED = Pattern(
    "rights.forged",
    "{kind} is not signed by this lab's web, and not given by a program of the station's account: "
    "refused; stops are obeyed",
)

SIGNED = "web:"  # prefix of holder names that require a signature
PANEL = "panel:"  # prefix of holders at the station's own panel, a program of this account
PROGRAMS = (
    "robot:"  # prefix of programs that drive through a robot server, which no page can ask for the lease
)
SCRIPTS = "channel:"  # prefix of scripts' holders; the channel forwards them without knowing who they are
# Roles outside the web: programs of this account, scripts that these forward, all others.
LOCAL, SCRIPT, UNVERIFIED = "local", "script", "unverified"
_ROLE_COMMANDS = ("operator", "admin", LOCAL, SCRIPT)
# Commands without a required role: they change nothing, or only hold or end what needed a role.
_OPEN = (
    *("status", "events_since", "aim", "preflight_report", "policy_server"),
    *("lease_renew", "lease_give_up"),
)
_KEY_BYTES = 32
_ROOT = 0
_DOMAIN = b"eva-web command 1\0"


class Key:
    """Secret that web and station share: DATA/stations/NAME/bus.key, readable by this account only."""

    def __init__(self, station_dir: Path) -> None:
        self.path = station_dir / "bus.key"
        self._secret = b""
        self._seen = (0, 0)  # inode and modification time of the file that was read

    def secret(self) -> bytes:
        """Return the key; create it if there is none.

        Raises:
            ConfigurationError: its file is unusable; the message has the reason.
        """
        try:
            return self._read()
        except FileNotFoundError:
            return self._make()
        except OSError as error:
            raise ConfigurationError(f"the key {self.path} cannot be read: {error.strerror}") from None

    def sign(self, payload: bytes) -> bytes:
        """Return the signature of a message.

        Raises:
            ConfigurationError: there is no usable key.
        """
        return hmac.digest(self.secret(), _DOMAIN + payload, "sha256")

    def verifies(self, payload: bytes, signature: bytes) -> bool:
        """Return True if the web signed exactly this message; False also if the key is unusable."""
        try:
            return hmac.compare_digest(self.sign(payload), signature)
        except ConfigurationError:
            return False

    def _read(self) -> bytes:
        status = os.stat(self.path, follow_symlinks=False)
        if (status.st_ino, status.st_mtime_ns) == self._seen:
            return self._secret
        if not stat.S_ISREG(status.st_mode) or status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise ConfigurationError(
                f"the key {self.path} has the mode {stat.S_IMODE(status.st_mode):04o}: a reader can sign commands "
                "as any user; allowed: a file with 0600; remove it, and another is made"
            )
        if status.st_uid not in (os.geteuid(), _ROOT):
            raise ConfigurationError(
                f"the key {self.path} belongs to {account_name(status.st_uid)}; allowed: {account_name(os.geteuid())}"
            )
        secret = self.path.read_bytes()
        if len(secret) != _KEY_BYTES:
            raise ConfigurationError(
                f"the key {self.path} has {len(secret)} bytes; allowed: {_KEY_BYTES}; remove it, and another is made"
            )
        self._secret, self._seen = secret, (status.st_ino, status.st_mtime_ns)
        return secret

    def _make(self) -> bytes:
        """Create the key and return it; if station and web create it at once, both get the first one.

        The file appears complete, so that no reader gets a part of it.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            create_durably(self.path, secrets.token_bytes(_KEY_BYTES), 0o600)
            return self._read()
        except OSError as error:
            raise ConfigurationError(f"the key {self.path} cannot be made: {error.strerror}") from None


def authenticate(command: Command, payload: bytes, signature: bytes, uid: int | None, key: Key) -> Command:
    """Return the command with user and role as verified, whatever the command claims.

    `signature` is empty if unsigned; `uid` is the connecting account, None if unknown. The role is the one that the web
    signed, "local" for a program of this account, "script" for a command that such a program forwards, else
    "unverified".
    """
    if signature:
        return command if key.verifies(payload, signature) else _unverified(command, UNVERIFIED)
    if uid is None or uid not in (os.geteuid(), _ROOT) or command.holder.startswith(SIGNED):
        return _unverified(command, UNVERIFIED)
    if command.holder.startswith(SCRIPTS):
        return _unverified(command, SCRIPT)
    user = command.holder if command.holder.startswith(PANEL) else f"account:{account_name(uid)}"
    return replace(command, user=user, role=LOCAL)


def at_the_panel(command: Command) -> bool:
    """Return True if an authenticated command comes from the station's own panel."""
    return command.role == LOCAL and command.holder.startswith(PANEL)


def _unverified(command: Command, role: str) -> Command:
    """Return the command with its claimed name, marked as unverified for all records."""
    name = command.user or command.holder or "somebody"
    return replace(command, user=f"{name} (unverified)", role=role)


def unverified_reason(command: Command) -> str:
    """Return the reason to refuse a command whose sender could not be verified.

    The result is "" if the sender is verified. Stops are executed whoever sends them: callers do not check them with
    this function.
    """
    if command.role != UNVERIFIED:
        return ""
    return _FORGED(kind=command.kind)


def missing_role(command: Command) -> str:
    """Return the reason if the sender's role does not permit the command; "" if it does."""
    if command.kind in _OPEN or command.role in _ROLE_COMMANDS:
        return ""
    return _NEEDS_OPERATOR(kind=command.kind, user=command.user, role=command.role or _WITHOUT_ROLE)


def display_name(command: Command) -> str:
    """Return the sender's name for the record, with the role that the web signed."""
    name = command.user or command.holder or "unknown"
    return name if command.role in ("", LOCAL, SCRIPT, UNVERIFIED) else f"{name} ({command.role})"
