from runtime.cameras.base import describe_camera_problems

TOLD = {
    "high": {"source": "rtsp://h/x", "condition": "lost", "why": "mute"},
    "wrist": {"source": "/dev/video0", "condition": "live", "why": ""},
    "low": {"source": "a.mp4", "condition": "opening", "why": "there is no such file"},
}


def test_every_camera_that_is_not_live_has_a_sentence():
    assert describe_camera_problems(TOLD) == [
        "camera high (rtsp://h/x) is lost: mute",
        "camera low (a.mp4) is opening: there is no such file",
    ]


def test_of_some_cameras_only_those_that_are_ours_are_told():
    assert describe_camera_problems(TOLD, ["low", "of_the_transport"]) == [
        "camera low (a.mp4) is opening: there is no such file"
    ]
    assert describe_camera_problems({}) == []
