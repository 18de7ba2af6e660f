"""Program that opens pages at a station, all in this process: `python -m benchmarks.viewers URL STATION COOKIE ...`.

It prints a line of JSON: the age of every snapshot on arrival at a viewer [ms], and the frames per viewer.
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
    options = parser.parse_args()
    print(json.dumps(asyncio.run(_watch(options))))
    return 0


async def _watch(options: argparse.Namespace) -> dict[str, list[float]]:
    ages: list[float] = []
    watching = [_read(options, number, ages) for number in range(options.reading)]
    stalled = [_stall(options, number) for number in range(options.stalled)]
    frames = await asyncio.gather(*watching, *stalled)
    return {"ages_ms": ages, "frames": [float(count) for count in frames[: options.reading]]}


def _page(arguments: argparse.Namespace, name: str, **options: object) -> connect:
    address = urlsplit(arguments.url)
    return connect(
        f"ws://{address.netloc}/ws/stations/{arguments.station}?page={name}",
        origin=arguments.url,
        additional_headers={"Cookie": arguments.cookies},
        max_size=2**24,
        **options,  # type: ignore[arg-type]
    )


async def _ask(socket: ClientConnection, options: argparse.Namespace) -> None:
    await socket.send(json.dumps({"type": "watch", "streams": options.streams.split(",")}))


async def _read(options: argparse.Namespace, number: int, ages: list[float]) -> int:
    frames = 0
    async with _page(options, f"reading{number}") as socket:
        await _ask(socket, options)
        end = time.monotonic() + options.seconds
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


async def _stall(options: argparse.Namespace, number: int) -> int:
    """Play a viewer that stalls: request all streams, then read nothing from the connection until the time is over.

    `number` distinguishes the viewers of one process.
    """
    async with _page(options, f"stalled{number}", ping_interval=None, max_queue=1, close_timeout=1) as socket:
        await _ask(socket, options)
        socket.transport.pause_reading()
        await asyncio.sleep(options.seconds)
        socket.transport.resume_reading()
    return 0


if __name__ == "__main__":
    sys.exit(main())
