"""Real-time settings of Linux for control, reception and guard: scheduling class, locked memory, garbage collection."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import struct

from runtime.core.sentences import Pattern

_NOT_PERMITTED = Pattern(
    "timing.not_permitted",
    "control runs in the class {scheduling!r}: SCHED_FIFO is not permitted, so that ticks can be "
    "milliseconds late on a busy machine; give the station's user an rtprio limit of {priority} "
    "(LimitRTPRIO={priority} where systemd starts it), then start the station anew: "
    "docs/administrator.md, Real time",
)

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_SYS_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_SLICE_NS = 100_000
_LARGE = 8 << 20  # [bytes] of one mapping
LOCKSTEP = "lockstep"  # class of ticks without real time


def enter_realtime(priority: int) -> str:
    """Make this process as punctual as permitted; return the scheduling class obtained, for the status.

    The first permitted of these is used: SCHED_FIFO at `priority`, or at the highest that the user's rtprio limit
    permits; a scheduler slice of 0.1 ms (Linux 6.12 and later); the ordinary class. "unlocked" is appended if its
    memory may be paged out.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    _fine_timers(libc)
    locked = _locked_memory(libc, _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    if locked:
        _read_in(libc)
    _quiet_gc()
    return _class(libc, priority, locked)


def enter_realtime_below(priority: int) -> str:
    """Make this process punctual, at a priority one below that of a process that enters with `priority`.

    Return the scheduling class obtained. This is for a process with threads and large, sparse memory. Threads started
    later inherit the class, unless they call `leave_realtime`. Memory mapped so far is locked page by page on first
    use. Later mappings are not locked, because a lock could be refused in the middle of the work.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    _fine_timers(libc)
    locked = _locked_memory(libc, _MCL_CURRENT | _MCL_ONFAULT)
    gc.collect()
    gc.freeze()
    return _class(libc, priority, locked, below=1)


def leave_realtime(thread: int = 0) -> None:
    """Remove the thread with id `thread` (0: the calling one) from a real-time class.

    Threads that it starts later are in no real-time class either.
    """
    with contextlib.suppress(ProcessLookupError):  # the thread has ended
        if os.sched_getscheduler(thread) in (os.SCHED_FIFO, os.SCHED_RR):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def leave_realtime_all() -> None:
    """Remove all threads of this process from a real-time class."""
    for thread in os.listdir("/proc/self/task"):
        leave_realtime(int(thread))


def advice(scheduling: str, priority: int) -> str:
    """Return advice to make a station punctual if control got the class `scheduling`; "" if none is needed."""
    if scheduling.startswith("FIFO") or scheduling == LOCKSTEP:
        return ""
    return _NOT_PERMITTED(scheduling=scheduling, priority=priority)


def _fine_timers(libc: ctypes.CDLL) -> None:
    """Make this process wake up on time, as a real-time class always does.

    By default timers fire up to 50 us late, several at once.
    """
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _locked_memory(libc: ctypes.CDLL, what: int) -> bool:
    return int(libc.mlockall(what)) == 0


def _read_in(libc: ctypes.CDLL) -> None:
    """Load mapped files into memory: otherwise code would be read from disk in the middle of a tick when it first runs.

    Large anonymous memory is locked on first use, at a microsecond per page and without disk access: of BLAS buffers
    (32 MB each) and thread stacks (8 MB) hardly any is ever used.
    """
    with open("/proc/self/maps", encoding="utf-8") as maps:
        for line in maps:
            span, rights, _, _, file, *name = line.split(maxsplit=5)
            start, end = (int(bound, 16) for bound in span.split("-"))
            unnamed = file == "0" and not name
            if rights[0] == "r" and not (unnamed and end - start >= _LARGE):
                libc.mlock(ctypes.c_void_p(start), ctypes.c_size_t(end - start))


def _quiet_gc() -> None:
    """Exclude imported objects from garbage collection and disable it; the loop collects between two ticks."""
    gc.collect()
    gc.freeze()
    gc.disable()


def _class(libc: ctypes.CDLL, priority: int, locked: bool, below: int = 0) -> str:
    got = _fifo(priority, below) or ("slice 0.1 ms" if _short_slice(libc) else "ordinary")
    return got if locked else f"{got} unlocked"


def _fifo(priority: int, below: int = 0) -> str:
    """Enter SCHED_FIFO and return the class, "" if not permitted.

    A process that passes `below` gets a priority that is lower by this number than the priority of a process that
    passes the same `priority` alone. If `priority` exceeds the permitted limit, the limit takes its place.
    """
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    for candidate in (priority - below, min(priority, limit) - below):
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(candidate))
        except OSError:  # not permitted, or an invalid priority: try the next best
            continue
        return f"FIFO {candidate}"
    return ""


def _short_slice(libc: ctypes.CDLL) -> bool:
    """Request a short scheduler slice (sched_setattr(2)): EEVDF schedules such a process sooner."""
    number = _SYS_SCHED_SETATTR.get(os.uname().machine)
    if number is None:
        return False
    # struct sched_attr: size, policy, flags, nice, priority, runtime (the slice), deadline, period
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = struct.pack("@IIQiIQQQ", 48, os.SCHED_OTHER, 0, nice, 0, _SLICE_NS, 0, 0)
    if int(libc.syscall(number, 0, attributes, 0)) != 0:
        return False
    taken = ctypes.create_string_buffer(48)
    read = int(libc.syscall(number + 1, 0, taken, 48, 0))
    return read == 0 and struct.unpack("@IIQiIQQQ", taken.raw)[5] == _SLICE_NS
