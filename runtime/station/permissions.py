"""Permissions of commands: whose tables they may bring along, and what of the station's own these may name.

The station's own account, which `ctl` and the control channel act for, may name whatever it can reach itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from runtime.config.loader import Resolved, changed
from runtime.config.schema import Deployment
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.core.machine_names import Names, named
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.identity import LOCAL, SCRIPT
from runtime.ipc.messages import Command

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

# Roles of who gives a command: a program of the station's account, a script on the channel.
OWN_ACCOUNT = (LOCAL, SCRIPT)
ADMINISTRATOR = "admin"
_WITH_TABLES = ("setup", "preflight", "policy_server")
_OF_ADMINISTRATORS = ("policy", "checkpoint")


def require(command: Command, own: Resolved) -> None:
    """RuntimeFault where who gives the command may not bring what it brings; `own` is the station's deployment.

    Commands that stop are never looked at.
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
            wanted = changed(own, {"policy": table}, command.kind)
        except ConfigurationError:  # told by who carries the command out, of a preflight in its report
            return
        require_named(own.deployment, wanted.deployment)


def require_named(own: Deployment, given: Deployment) -> None:
    """ConfigurationError where the policy of `given` names a variable or a file that is not for others to name.

    What the deployment's own [policy] names stays allowed.
    """
    said = {(what, value) for _, what, value in named(own.policy)}
    for key, what, value in named(given.policy):
        if (what, value) not in said and not _is_allowed(own, what, value):
            raise ConfigurationError(f"policy.{key} = {value!r:.200}: {_advice(own, what)}")


def _is_allowed(own: Deployment, what: Names, value: str) -> bool:
    if what is Names.VARIABLE:
        return any(fnmatchcase(value, pattern) for pattern in own.security.variables)
    if what is Names.RECORDING:
        ours = _within(value, _recordings(own)) and _is_recording(value)
        return ours or _within(value, own.security.files)
    listed = own.security.files if what is Names.FILE else ()
    if value == "none":  # of ssh's configuration: none is read
        return True
    return _within(value, (own.ssh_dir, *listed))


def _advice(own: Deployment, what: Names) -> str:
    if what is Names.VARIABLE:
        allowed = ", ".join(own.security.variables) or "none"
        return _VARIABLES_OF_WEB(allowed=allowed)
    if what is Names.WRITTEN:
        return _WRITTEN_FILES_OF_WEB(folder=own.ssh_dir)
    if what is Names.RECORDING:
        return _RECORDINGS_OF_WEB(where=own.data, listed=_LISTED_FILES)
    return _FILES_OF_WEB(where=own.ssh_dir, listed=_LISTED_FILES)


def _recordings(own: Deployment) -> Iterable[Path]:
    """The data folder, also where the lab has put a part of it on another disk."""
    return own.data, own.episodes_dir, own.data / "datasets"


def _is_recording(value: str) -> bool:
    """True for the folder of a recording or of a dataset: the data folder has other files, which nobody names."""
    path = _place(value)
    return (path / "manifest.json").is_file() or (path / "meta" / "info.json").is_file()


def _within(value: str, allowed: Iterable[str | Path]) -> bool:
    """True if a path leads to one of these files or below one of these folders, links and `..` followed."""
    try:
        path = _place(value)
        return any(path.is_relative_to(_place(one)) for one in allowed)
    except (OSError, RuntimeError, ValueError):  # no path, or links in a circle
        return False


def _place(path: str | Path) -> Path:
    return Path(os.path.expanduser(path)).resolve()
