"""Every fault of a camera's server against every kind of live camera: named, said in a clause, and looked for again."""

from __future__ import annotations

import pytest

from runtime.cameras.base import CameraCondition
from runtime.standins.camera_server import FAULTS
from runtime.standins.mjpeg_server import MjpegServer
from tests.runtime.cameras.movies import until
from tests.runtime.cameras.watched import KINDS, both, live, looking, lost, watched

pytestmark = pytest.mark.usefixtures("no_thread_is_left")

MUTE = "mute: it sent no picture within 0.5 s"
LOGIN = "it wants a login: set user and password_env, or correct them"
NO_MJPEG = "no MJPEG stream: it answers with {}, not multipart/x-mixed-replace"
ON_OPENING = {
    "rtsp": {
        "mute": MUTE,
        "garbage": "the server there is not an RTSP server with a video",
        "not_found": "404: there is nothing at that path",
        "no_login": LOGIN,
        "silent": MUTE,
        "trickle": MUTE,
        "torn": "it closed the connection",
        "nonsense": "what it sent for 3 s cannot be decoded",
    },
    "mjpeg": {
        "mute": MUTE,
        "garbage": NO_MJPEG.format("something else"),
        "not_found": "404: there is nothing at that path",
        "no_login": LOGIN,
        "silent": MUTE,
        "trickle": MUTE,
        "torn": "its stream ends before the first picture",
        "nonsense": "what it sent for 3 s cannot be decoded",
        "html": NO_MJPEG.format("text/html"),
        "png": "what it sent for 0.5 s cannot be decoded: parts of type image/png, no JPEG",
        "still": "it answers with one picture and ends, not multipart/x-mixed-replace: "
        "take the address of its stream",
    },
}
WHILE_IT_PLAYS = {
    "silent": MUTE,
    "torn": "it closed the connection",
    "nonsense": "what it sent for 3 s cannot be decoded",
}


def _looked_for(fault: str) -> float:
    """Seconds of a look: a machine that stands still for two of them has still seen what is sent."""
    return 3.0 if fault == "nonsense" else 0.5


def test_every_fault_that_a_stand_in_can_play_is_played() -> None:
    for kind in KINDS:
        assert set(FAULTS) <= set(ON_OPENING[kind])


@pytest.mark.parametrize(("kind", "fault"), [(kind, fault) for kind in KINDS for fault in ON_OPENING[kind]])
def test_what_was_found_in_its_place_is_said(kind: str, fault: str) -> None:
    seconds = _looked_for(fault)
    with watched(kind, fault, open_s=seconds, read_s=seconds) as (_, camera):
        until(lambda: camera.health().failed)
        health = camera.health()
        assert (health.condition, health.why) == (CameraCondition.OPENING, ON_OPENING[kind][fault])
        assert camera.latest() is None


@pytest.mark.some(2)
@both
@pytest.mark.parametrize("fault", WHILE_IT_PLAYS)
def test_what_breaks_while_it_plays_is_lost_and_comes_back(kind: str, fault: str) -> None:
    with watched(kind, read_s=_looked_for(fault)) as (server, camera):
        until(lambda: live(camera))
        server.fault = fault
        until(lambda: lost(camera))
        health, kept = camera.health(), camera.latest()
        assert health.losses == 1
        assert health.why.startswith(WHILE_IT_PLAYS[fault])
        assert kept is not None, "the newest picture stays, and grows old"
        server.fault = ""
        until(lambda: live(camera))
        assert camera.latest().captured > kept.captured  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "headers",
    [
        ("Content-Type: image/jpg", "Content-Length: {length}"),
        ("Content-Type: image/jpeg; charset=utf-8", "Content-Length: {length}"),
        ("Content-Length: {length}",),
        (),
        ("Content-Type: image/jpeg", "Content-Length: 7"),
        ("Content-Type: image/jpeg", "Content-Length: 9{length}"),
        ("Content-Type: image/jpeg", "Content-Length: many"),
    ],
)
def test_pictures_are_seen_whatever_their_parts_are_called(headers: tuple[str, ...]) -> None:
    with watched("mjpeg") as (server, camera):
        assert isinstance(server, MjpegServer)
        server.headers = headers
        server.hang_up()  # that of before, if it was quick
        until(lambda: live(camera) and server.sent > 0)
        until(lambda: camera.latest() is not None)
        assert camera.latest().picture.shape == (120, 160, 3)  # type: ignore[union-attr]


@both
def test_a_port_at_which_nobody_listens_refuses(kind: str) -> None:
    made, module = KINDS[kind]
    server = made()
    url = server.start()
    server.close()
    with looking(module, url) as camera:
        until(lambda: camera.health().failed)
        assert camera.health().why == "refused: nothing listens at that port"


@both
def test_a_server_that_stops_and_comes_back_is_found_again(kind: str) -> None:
    with watched(kind) as (server, camera):
        until(lambda: live(camera))
        server.close()
        until(lambda: "refused" in camera.health().why)
        since = camera.health().since
        assert camera.health().condition is CameraCondition.LOST
        server.start()
        until(lambda: live(camera))
        assert camera.health().since > since


@both
def test_another_resolution_is_refused_until_it_is_set_back(kind: str) -> None:
    with watched(kind) as (server, camera):
        until(lambda: live(camera))
        server.size = (80, 60)
        until(lambda: lost(camera))
        assert "were 160x120 and are 80x60 now" in camera.health().why
        assert camera.latest().picture.shape == (120, 160, 3)  # type: ignore[union-attr]
        server.size = (160, 120)
        until(lambda: live(camera))
