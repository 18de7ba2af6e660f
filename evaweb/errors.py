"""The one family of errors that a person may read; evaweb.api turns them into HTTP answers."""

from __future__ import annotations


class EvaError(Exception):
    """Something asked for that cannot be done; the message says what, what was given and what is allowed."""

    status = 400


class NotAllowed(EvaError):
    """This user may not do this."""

    status = 403


class NotFound(EvaError):
    """The named thing does not exist."""

    status = 404


class Conflict(EvaError):
    """It cannot be done in the present state."""

    status = 409


class StationGone(EvaError):
    """The station does not answer."""

    status = 503
