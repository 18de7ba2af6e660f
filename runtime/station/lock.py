"""Lock of a running station, so that each station name runs at most once per data folder."""

from __future__ import annotations

from typing import IO

from runtime.config.schema import Deployment
from runtime.core.errors import SetupError
from runtime.ipc.station_lock import StationLockedError, acquire


def acquire_station_lock(settings: Deployment) -> IO[str]:
    """Return the lock of a station, which is held until the returned file is closed.

    Raises SetupError, which names the process that has the lock, or the cause.
    """
    try:
        return _locked(settings)
    except OSError as error:
        raise unwritable_error(settings, error) from None


def unwritable_error(settings: Deployment, error: OSError) -> SetupError:
    """Return the error to raise for a station folder that cannot be written."""
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
