"""Lease, the right to command: one holder at a time, with epoch and time to live."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from runtime.core.sentences import Pattern, fixed

_NEEDS_A_HOLDER = fixed("lease.needs_a_holder", "a lease needs the name of its holder")
_EPOCH_IMPOSSIBLE = Pattern("lease.epoch_impossible", "epoch {epoch} is impossible; allowed: 0 to {highest}")
_HELD_FOR_ANOTHER = Pattern("lease.held_for_another", "{holder} holds the lease for another {seconds:.1f} s")
_EPOCH_OVER = Pattern("lease.epoch_over", "epoch {epoch} is over, the lease is in epoch {newest}")
_NOBODY_HOLDS = fixed("lease.nobody_holds", "the station has no operator: take it first")
_HELD_BY = Pattern("lease.held_by", "{holder} holds the lease")
_OTHER_EPOCH = Pattern("lease.other_epoch", "epoch {epoch} is not the lease's epoch {newest}")

HIGHEST_EPOCH = 2**52  # of a claim; beyond 2**53 a browser's integers are inexact


@dataclass(frozen=True, slots=True)
class LeaseState:
    """Lease: holder, epoch, expiry on our monotonic clock; `by` is the holder's display name.

    `hidden` is True if the holder's page has reported that it is hidden, and the lease was not renewed after that
    report.
    """

    holder: str
    epoch: int
    until: float
    by: str = ""
    hidden: bool = False


class Lease:
    """Right to command with at most one holder.

    A higher epoch takes over, a lower one is refused. The lease expires without renewal.
    """

    def __init__(self, ttl: float) -> None:
        self._ttl = ttl
        self._held: LeaseState | None = None
        self._epoch = 0  # of the newest lease ever granted

    def current(self, now: float) -> LeaseState | None:
        """Return the lease that is valid at `now`, None if there is none."""
        return self._held if self._held and now < self._held.until else None

    def status(self, now: float) -> dict[str, Any]:
        """Return holder, name, epoch and remaining seconds; without a lease the newest epoch and no holder."""
        lease = self.current(now)
        if lease is None:
            return {"holder": "", "by": "", "epoch": self._epoch, "expires_in": 0.0}
        return {"holder": lease.holder, "by": lease.by, "epoch": lease.epoch, "expires_in": lease.until - now}

    def lost(self, now: float) -> bool:
        """Return True if the newest lease has expired unintentionally.

        An expiry is intended if the holder has released the lease, or if the holder's page is hidden.
        """
        return self._held is not None and now >= self._held.until and not self._held.hidden

    @property
    def epoch(self) -> int:
        return self._epoch

    def raise_epoch_floor(self, epoch: int) -> None:
        """Invalidate all epochs up to `epoch`, which were used before a restart."""
        self._epoch = max(self._epoch, epoch)

    def claim(self, holder: str, epoch: int, now: float, by: str = "") -> str:
        """Claim or extend the lease; return "" if granted, else the reason.

        A terminal passes epoch 0: it claims a free lease with the next epoch, or extends its own lease.
        """
        if not holder:
            return _NEEDS_A_HOLDER
        if not 0 <= epoch <= HIGHEST_EPOCH:
            return _EPOCH_IMPOSSIBLE(epoch=epoch, highest=HIGHEST_EPOCH)
        lease = self.current(now)
        if lease and lease.holder == holder and epoch in (0, lease.epoch):
            self._held = replace(lease, until=now + self._ttl, hidden=False)
            return ""
        if epoch == 0:
            if lease:
                return _HELD_FOR_ANOTHER(holder=lease.holder, seconds=lease.until - now)
            epoch = self._epoch + 1
        # An epoch that was used before can never be granted again, so that a delayed claim does not take the
        # lease back.
        if epoch <= self._epoch:
            return _EPOCH_OVER(epoch=epoch, newest=self._epoch)
        self._epoch = epoch
        self._held = LeaseState(holder, epoch, now + self._ttl, by)
        return ""

    def renew(self, holder: str, epoch: int, now: float, by: str = "") -> str:
        """Extend the lease; return "" if done, else the reason."""
        refusal = self.check(holder, epoch, now)
        if not refusal and self._held:
            self._held = replace(self._held, until=now + self._ttl, hidden=False)
        return refusal

    def hide(self, holder: str, epoch: int, now: float) -> None:
        """Record that the holder's page is hidden.

        The lease is not extended by this. When it expires, this does not count as a loss of the holder.
        """
        if not self.check(holder, epoch, now) and self._held:
            self._held = replace(self._held, hidden=True)

    def release(self, holder: str, epoch: int, now: float, by: str = "") -> str:
        """End the lease early; return "" if done, else the reason."""
        refusal = self.check(holder, epoch, now)
        if not refusal:
            self._held = None
        return refusal

    def check(self, holder: str, epoch: int, now: float) -> str:
        """Return "" if this holder may command at `now`, else the reason."""
        lease = self.current(now)
        if lease is None:
            return _NOBODY_HOLDS
        if lease.holder != holder:
            return _HELD_BY(holder=lease.holder)
        if lease.epoch != epoch:
            return _OTHER_EPOCH(epoch=epoch, newest=lease.epoch)
        return ""
