import json
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from runtime.cameras import mjpeg, rtsp
from runtime.cameras.video_stream import VideoStream
from runtime.standins.camera import main
from runtime.standins.camera_server import FAULTS, picture
from runtime.standins.mjpeg_server import MjpegServer
from runtime.standins.rtsp_server import _payloads
from tests.processes import PATIENCE_S

MODULES = {"mjpeg": mjpeg, "rtsp": rtsp}


@pytest.mark.some(1)
@pytest.mark.parametrize("kind", MODULES)
def test_the_command_serves_a_camera_until_its_lifeline_ends(kind):
    command = [
        sys.executable,
        "-m",
        "runtime.standins.camera",
        kind,
        "--width",
        "96",
        "--height",
        "64",
        "--lifeline",
    ]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    told = json.loads(child.stdout.readline())
    assert told["kind"] == kind
    module = MODULES[kind]
    feed = VideoStream(module.address(module.Config(url=told["url"])), 5.0, 5.0)
    assert feed.read().picture.shape == (64, 96, 3)
    feed.close()
    child.stdin.close()
    assert child.wait(PATIENCE_S) == 0
    child.stdout.close()


def test_a_port_that_is_taken_is_said(capsys, monkeypatch):
    from runtime.simulation import program

    monkeypatch.setattr(program, "stop_event", lambda lifeline: None)
    server = MjpegServer()
    port = server.start().rpartition(":")[2].partition("/")[0]
    assert main(["mjpeg", "--port", port]) == 2
    assert f"--port {port} cannot be taken" in capsys.readouterr().err
    server.close()


def test_every_picture_is_another_one():
    shown = [picture(number, 160, 120) for number in range(19)]
    assert all(not np.array_equal(one, other) for one, other in pairwise(shown))
    assert set(FAULTS) >= {"mute", "garbage", "torn", "trickle", "silent"}


def test_a_long_unit_is_cut_and_joined_again_as_the_standard_says():
    unit = bytes([0x65]) + bytes(range(256)) * 20
    parts = list(_payloads(unit, last=True))
    assert [part[0] & 0x1F for part, _ in parts] == [28] * len(parts)
    assert [(part[1] >> 7, part[1] >> 6 & 1) for part, _ in parts] == [(1, 0), (0, 0), (0, 0), (0, 1)]
    assert [marked for _, marked in parts] == [False, False, False, True]
    head = parts[0][0]
    assert bytes([head[0] & 0xE0 | head[1] & 0x1F]) + b"".join(part[2:] for part, _ in parts) == unit
    assert list(_payloads(unit[:100], last=False)) == [(unit[:100], False)]
