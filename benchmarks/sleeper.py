"""The common way to pace a loop, measured beside ours: work, then sleep what is left of the period."""

from __future__ import annotations

import json
import sys
import time


def main() -> None:
    """Loop at argv[1] Hz for argv[2] seconds; print the wake-up times on the monotonic clock."""
    period, seconds = 1.0 / float(sys.argv[1]), float(sys.argv[2])
    woke = [time.monotonic()]
    end = woke[0] + seconds
    while woke[-1] < end:
        started = woke[-1]
        time.sleep(max(0.0, period - (time.monotonic() - started)))
        woke.append(time.monotonic())
    print(json.dumps(woke))


if __name__ == "__main__":
    main()
