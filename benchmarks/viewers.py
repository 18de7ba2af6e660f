"""Open pages at a station, all in this process: `python -m benchmarks.viewers URL STATION COOKIE ...`.

Prints a line of JSON: the age of every snapshot on arrival at a viewer [ms], and the frames per viewer.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect

from evaweb.core.binary_frames import decode
from robots.broken_pipe import exit_on_broken_pipe


@exit_on_broken_pipe
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("station")
    parser.add_argument("cookies", help="of a session that is logged in, as a browser sends them")
    parser.add_argument("--streams", required=True, help="separated by commas")
    parser.add_argument("--reading", type=int, default=0, help="viewers that draw what they get")
    parser.add_argument("--stalled", type=int, default=0, help="viewers that never read")
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    print(json.dumps(asyncio.run(_watch(given))))
    return 0


async def _watch(given: argparse.Namespace) -> dict[str, list[float]]:
    ages: list[float] = []
    watching = [_read(given, number, ages) for number in range(given.reading)]
    stalled = [_stall(given, number) for number in range(given.stalled)]
    frames = await asyncio.gather(*watching, *stalled)
    return {"ages_ms": ages, "frames": [float(count) for count in frames[: given.reading]]}


def _page(given: argparse.Namespace, name: str, **options: object) -> connect:
    address = urlsplit(given.url)
    return connect(
        f"ws://{address.netloc}/ws/stations/{given.station}?page={name}",
        origin=given.url,
        additional_headers={"Cookie": given.cookies},
        max_size=2**24,
        **options,  # type: ignore[arg-type]
    )


async def _ask(socket: ClientConnection, given: argparse.Namespace) -> None:
    await socket.send(json.dumps({"type": "watch", "streams": given.streams.split(",")}))


async def _read(given: argparse.Namespace, number: int, ages: list[float]) -> int:
    frames = 0
    async with _page(given, f"reading{number}") as socket:
        await _ask(socket, given)
        end = time.monotonic() + given.seconds
        while (left := end - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(socket.recv(), left)
            except TimeoutError:
                break
            if isinstance(message, str):
                continue
            frames += 1
            streams = decode(message).header["streams"]
            if "state" in streams:  # its clock is the machine's monotonic clock too
                ages.append((time.monotonic() - streams["state"]["json"]["clock"]) * 1000)
            await socket.send(json.dumps({"type": "credit"}))
    return frames


async def _stall(given: argparse.Namespace, number: int) -> int:
    """Request everything, then read nothing from the connection until the time is over."""
    async with _page(given, f"stalled{number}", ping_interval=None, max_queue=1, close_timeout=1) as socket:
        await _ask(socket, given)
        socket.transport.pause_reading()
        await asyncio.sleep(given.seconds)
        socket.transport.resume_reading()
    return 0


if __name__ == "__main__":
    sys.exit(main())
