"""Lock of a running station, so that a data folder has only one of each name."""

from __future__ import annotations

from typing import IO

from runtime.config.schema import Deployment
from runtime.core.errors import SetupError
from runtime.ipc.station_lock import StationLockedError, acquire


def acquire_station_lock(settings: Deployment) -> IO[str]:
    """Return the lock of a station, held until it is closed.

    Raises SetupError with the process that has it, or the cause.
    """
    try:
        return _locked(settings)
    except OSError as error:
        raise unwritable_error(settings, error) from None


def unwritable_error(settings: Deployment, error: OSError) -> SetupError:
    """Return the error about a station folder that cannot be written."""
    return SetupError(
        f"{settings.station_dir} cannot be written ({error.strerror}): make room there, or name another folder with "
        "data_dir"
    )


def _locked(settings: Deployment) -> IO[str]:
    try:
        return acquire(settings.station_dir)
    except StationLockedError as taken:
        raise SetupError(
            f"station {settings.station!r} is already running (process {taken.by}); "
            "end it first, or give this one another name with --set station=NAME"
        ) from None
