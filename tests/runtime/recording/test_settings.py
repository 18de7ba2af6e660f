import pytest

from runtime.core.errors import ConfigurationError
from runtime.recording import encoder_check
from runtime.recording.codecs import CODECS
from runtime.recording.settings import RecordingSettings


@pytest.mark.parametrize("codec", list(CODECS))
def test_every_encoder_has_values_of_its_own_where_none_are_given(codec: str) -> None:
    settings = RecordingSettings.model_validate({"codec": codec})
    assert settings.chosen_preset in CODECS[codec].presets
    assert 0 <= settings.chosen_crf <= 51


def test_h264_is_the_default() -> None:
    settings = RecordingSettings()
    assert (settings.codec, settings.chosen_preset, settings.chosen_crf) == ("libx264", "veryfast", 23)
    assert CODECS[settings.codec].coded == "h264"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"preset": "p4"}, "recording.preset = 'p4' with codec 'libx264'; allowed: ultrafast, .*veryslow"),
        ({"codec": "libsvtav1"}, "recording.codec = 'libsvtav1': .* has stopped for good"),
        ({"codec": "h264_nvenc", "preset": "veryfast"}, "recording.preset = 'veryfast' .*allowed: p1, p2"),
    ],
)
def test_what_does_not_fit_the_encoder_is_named_with_what_does(given: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        RecordingSettings.model_validate(given)


@pytest.mark.parametrize(
    "given",
    [
        {"codec": "mpeg2video"},
        {"crf": 52},
        {"gop": 0},
        {"height": 481},
        {"heights": {"front": 8}},
        {"max_lag_s": 0.0},
    ],
)
def test_other_values_are_refused_by_key(given: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(given))):
        RecordingSettings.model_validate(given)


def test_groups_are_half_a_second_where_they_are_not_given() -> None:
    assert [RecordingSettings().chosen_gop(fps) for fps in (1.0, 10.0, 30.0, 60.0)] == [1, 5, 15, 15]
    assert RecordingSettings(gop=2).chosen_gop(1.0) == 2


def test_videos_are_scaled_in_proportion_and_never_up() -> None:
    cameras = {"front": (480, 640), "wrist": (240, 424), "top": (100, 50)}
    assert RecordingSettings().sizes(cameras) == cameras
    scaled = RecordingSettings(height=240, heights={"wrist": 120, "top": 2160}).sizes(cameras)
    assert scaled == {"front": (240, 320), "wrist": (120, 212), "top": (100, 50)}


def test_an_encoder_that_this_machine_lacks_is_named_with_those_that_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def create(name: str, mode: str) -> object:
        raise ValueError(f"no such codec {name!r}")

    encoder_check.require_encoder(RecordingSettings())
    real = encoder_check.av.CodecContext.create
    monkeypatch.setattr(
        encoder_check.av.CodecContext,
        "create",
        lambda name, mode: real(name, mode) if name == "libx264" else create(name, mode),
    )
    with pytest.raises(
        ConfigurationError, match=r"recording.codec = 'libx265' does not work .*allowed here: libx264$"
    ):
        encoder_check.require_encoder(RecordingSettings(codec="libx265"))
