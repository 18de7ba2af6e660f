import pytest

from runtime.cameras.camera_urls import check_url, with_password
from runtime.core.errors import ConfigurationError


@pytest.mark.parametrize("url", ["rtsp://10.0.0.7/stream", "rtsps://camera.lab:8554/a/b?c=1"])
def test_a_url_of_the_scheme_is_left_as_it_is(url):
    assert check_url("url", url, ("rtsp", "rtsps")) == url


@pytest.mark.parametrize(
    "url", ["", "10.0.0.7", "http://10.0.0.7/", "rtsp:///path", "rtsp://h:99999/x", "rtsp://["]
)
def test_what_is_no_such_url_is_refused_with_what_is_allowed(url):
    with pytest.raises(ConfigurationError, match=r"allowed: rtsp://HOST\[:PORT\]/PATH"):
        check_url("url", url, ("rtsp",))


def test_a_password_in_a_url_is_refused_and_not_repeated():
    with pytest.raises(ConfigurationError, match="password_env") as refused:
        check_url("url", "rtsp://admin:s3cret@10.0.0.7/x", ("rtsp",))
    assert "s3cret" not in str(refused.value)


def test_a_password_comes_from_the_environment_and_is_quoted(monkeypatch):
    monkeypatch.setenv("CAMERA_PASSWORD", "a/b@c")
    assert with_password("rtsp://h:1/x", "me", "CAMERA_PASSWORD") == "rtsp://me:a%2Fb%40c@h:1/x"
    assert with_password("rtsp://h:1/x", None, None) == "rtsp://h:1/x"


def test_a_password_that_is_not_set_is_named(monkeypatch):
    monkeypatch.delenv("CAMERA_PASSWORD", raising=False)
    with pytest.raises(ConfigurationError, match="CAMERA_PASSWORD, which is not set"):
        with_password("rtsp://h/x", "me", "CAMERA_PASSWORD")
