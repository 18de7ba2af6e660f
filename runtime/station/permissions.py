"""Permissions of commands: who may send tables with a command, and which files and variables these may name.

The station's own account, used by `ctl` and the control channel, may name anything that it can access itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from runtime.config.loader import Resolved, apply_changes
from runtime.config.schema import Deployment
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.core.host_references import HostReference, find_host_references
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.identity import LOCAL, SCRIPT
from runtime.ipc.messages import Command

_NOT_ALLOWED = Pattern("rights.not_allowed", "policy.{key} = {value!r:.200}: {advice}")
_TABLES_FOR_ADMINISTRATORS = Pattern(
    "rights.tables_for_administrators",
    "{kind}: {key} by {user}, whose role is {role}: tables are for administrators; allowed: a "
    "checkpoint, or a recorded episode, by its name",
)
_VARIABLES_OF_WEB = Pattern(
    "rights.variables_of_web",
    "a table from the web may name {allowed}, and what security.variables of the station's deployment lists",
)
_WRITTEN_FILES_OF_WEB = Pattern(
    "rights.written_files_of_web",
    "a table from the web may have a file written below {folder} alone",
)
_LISTED_FILES = fixed("rights.listed_files", "what security.files of the station's deployment lists")
_FILES_OF_WEB = Pattern(
    "rights.files_of_web",
    "a table from the web may name files below {where}, and {listed}",
)
_RECORDINGS_OF_WEB = Pattern(
    "rights.recordings_of_web",
    "a table from the web may name the folder of a recording or of a dataset below {where}, and {listed}",
)

# Roles of commands from the station's own account: a local program, a script on the channel.
OWN_ACCOUNT = (LOCAL, SCRIPT)
ADMINISTRATOR = "admin"
_WITH_TABLES = ("setup", "preflight", "policy_server")
_OF_ADMINISTRATORS = ("policy", "checkpoint")


def require(command: Command, own: Resolved) -> None:
    """Raise RuntimeFault if the command contains tables that its sender may not send.

    `own` is the station's deployment. Commands that stop the robot are never refused.
    """
    if command.kind not in _WITH_TABLES or command.role in OWN_ACCOUNT:
        return
    for key in _OF_ADMINISTRATORS:
        written = command.role == ADMINISTRATOR or key in command.vouched
        if command.args.get(key) is not None and not written:
            raise RuntimeFault(
                _TABLES_FOR_ADMINISTRATORS(
                    kind=command.kind, key=key, user=command.user or "somebody", role=command.role
                )
            )
    table = command.args.get("policy")
    if isinstance(table, Mapping):
        try:
            requested = apply_changes(own, {"policy": table}, command.kind)
        except ConfigurationError:  # reported when the command is executed, or in the preflight's report
            return
        require_allowed_references(own.deployment, requested.deployment)


def require_allowed_references(own: Deployment, given: Deployment) -> None:
    """Raise ConfigurationError if the policy of `given` names a variable or file that is not allowed.

    Names in the deployment's own [policy] stay allowed.
    """
    stated = {(kind, value) for _, kind, value in find_host_references(own.policy)}
    for key, kind, value in find_host_references(given.policy):
        if (kind, value) not in stated and not _is_allowed(own, kind, value):
            raise ConfigurationError(_NOT_ALLOWED(key=key, value=value, advice=_advice(own, kind)))


def _is_allowed(own: Deployment, kind: HostReference, value: str) -> bool:
    if kind is HostReference.VARIABLE:
        return any(fnmatchcase(value, pattern) for pattern in own.security.variables)
    if kind is HostReference.RECORDING:
        own_recording = _is_inside(value, _recordings(own)) and _is_recording(value)
        return own_recording or _is_inside(value, own.security.files)
    listed = own.security.files if kind is HostReference.FILE else ()
    if value == "none":  # ssh without a configuration file
        return True
    return _is_inside(value, (own.ssh_dir, *listed))


def _advice(own: Deployment, kind: HostReference) -> str:
    if kind is HostReference.VARIABLE:
        allowed = ", ".join(own.security.variables) or "none"
        return _VARIABLES_OF_WEB(allowed=allowed)
    if kind is HostReference.WRITTEN:
        return _WRITTEN_FILES_OF_WEB(folder=own.ssh_dir)
    if kind is HostReference.RECORDING:
        return _RECORDINGS_OF_WEB(where=own.data, listed=_LISTED_FILES)
    return _FILES_OF_WEB(where=own.ssh_dir, listed=_LISTED_FILES)


def _recordings(own: Deployment) -> Iterable[Path]:
    """Return the folders of recordings, including those that may be links to another disk."""
    return own.data, own.episodes_dir, own.data / "datasets"


def _is_recording(value: str) -> bool:
    """Return True if the path is the folder of a recording or dataset.

    A policy's settings must not name any other path in the data folder, unless the deployment's [security] allows it.
    """
    path = _resolved(value)
    return (path / "manifest.json").is_file() or (path / "meta" / "info.json").is_file()


def _is_inside(value: str, allowed: Iterable[str | Path]) -> bool:
    """Return True if the path is one of the files `allowed` or below one of these folders.

    Links and `..` are resolved first.
    """
    try:
        path = _resolved(value)
        return any(path.is_relative_to(_resolved(folder)) for folder in allowed)
    except (OSError, RuntimeError, ValueError):  # invalid path or circular links
        return False


def _resolved(path: str | Path) -> Path:
    return Path(os.path.expanduser(path)).resolve()
