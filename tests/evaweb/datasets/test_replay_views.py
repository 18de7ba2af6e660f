"""Episodes of datasets as pages play them: of any version, ours and those of others."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from asgiref.sync import async_to_sync
from django.test import AsyncClient, Client
from django.urls import reverse
from PIL import Image

from evaweb.core.binary_frames import decode
from evaweb.datasets import still_images
from evaweb.episodes.models import Episode
from evaweb.episodes.poses import MOST_ROWS
from evaweb.stations.models import Station
from runtime.datasets.operations import convert
from runtime.datasets.publishing import publish
from runtime.datasets.sidecars import attach_sidecar
from runtime.recording.files import RecordingError
from tests.runtime.datasets.foreign import column
from tests.runtime.datasets.small import JOINTS

pytestmark = pytest.mark.django_db
Foreign = Callable[..., Path]


def config(page: Any) -> dict[str, Any]:
    return dict(page.context["config"])


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_an_episode_of_any_version_is_shown_with_its_cameras_and_curves(
    browser: Client, foreign: Foreign, version: str
) -> None:
    foreign("cups", version=version)
    page = browser.get(reverse("dataset-replay", args=["cups", 1]))
    assert page.status_code == 200
    told = config(page)
    assert (told["frames"], told["fps"]) == (8, 10.0)
    assert [video["camera"] for video in told["videos"]] == ["cam_high", "cam_wrist"]
    # In v3.0 the file holds many episodes: the second one begins where the first ends.
    start = 0.6 if version == "v3.0" else 0.0
    assert [video["start"] for video in told["videos"]] == pytest.approx([start, start])
    curves = browser.get(told["curves"]).content
    header = decode(curves).header
    assert header["frames"] == 8
    assert np.array_equal(decode(curves).array("ticks", "measured").T, column(1, "observation.state", 8))
    assert np.array_equal(decode(curves).array("ticks", "executed").T, column(1, "action", 8))
    assert np.allclose(decode(curves).array("ticks", "time"), np.arange(8) / 10)
    assert set(decode(curves).array("ticks", "chunk").tolist()) == {-1}


def test_a_video_is_sent_in_parts(browser: Client, foreign: Foreign) -> None:
    folder = foreign("cups", version="v3.0")
    told = config(browser.get(reverse("dataset-replay", args=["cups", 2])))
    client = AsyncClient()
    client.cookies = browser.cookies

    async def ask() -> tuple[int, dict[str, str], bytes]:
        answer = await client.get(told["videos"][0]["address"], headers={"Range": "bytes=10-29"})
        return answer.status_code, dict(answer.headers), b"".join([piece async for piece in answer])

    status, headers, content = async_to_sync(ask)()
    (video,) = (folder / "videos/observation.images.cam_high").rglob("*.mp4")
    assert (status, content) == (206, video.read_bytes()[10:30])
    assert headers["Content-Type"] == "video/mp4"
    assert headers["Content-Range"] == f"bytes 10-29/{video.stat().st_size}"


def test_pictures_in_a_column_are_sent_one_by_one(browser: Client, foreign: Foreign) -> None:
    foreign("cups", videos=("cam_high",), images=("cam_wrist",))
    told = config(browser.get(reverse("dataset-replay", args=["cups", 1])))
    video, pictures = told["videos"]
    assert (video["pictures"], pictures["pictures"]) == (False, True)
    answer = browser.get(f"{pictures['address']}?row=7")
    assert answer.status_code == 200
    assert answer["Content-Type"] in ("image/png", "image/jpeg")
    assert browser.get(f"{pictures['address']}?row=8").status_code == 404
    assert browser.get(f"{pictures['address']}?row=-1").status_code == 400


def test_depth_of_16_bits_is_shown_in_shades(browser: Client, foreign: Foreign) -> None:
    folder = foreign("cups", version="v2.1", videos=(), images=("cam",))
    path, key = folder / "data/chunk-000/episode_000000.parquet", "observation.images.cam"
    table, sink = pq.read_table(path), io.BytesIO()
    Image.fromarray(np.repeat([[0, 1000, 2000]], 4, axis=0).astype(np.uint16)).save(sink, "PNG")
    rows = pa.array([sink.getvalue()] * table.num_rows)  # as their bytes alone
    pq.write_table(table.set_column(table.column_names.index(key), key, rows), path)
    (pictures,) = config(browser.get(reverse("dataset-replay", args=["cups", 0])))["videos"]
    answer = browser.get(f"{pictures['address']}?row=0")
    assert (answer.status_code, answer["Content-Type"]) == (200, "image/jpeg")
    shown = np.asarray(Image.open(io.BytesIO(answer.content)).convert("L")).mean(axis=0)
    assert np.allclose(shown, [0, 128, 255], atol=12)


def test_a_camera_with_a_slash_in_its_name_is_shown_as_any_other(browser: Client, foreign: Foreign) -> None:
    foreign("cups", version="v2.1", videos=("wrist/left",), images=("hand/right",))
    video, pictures = config(browser.get(reverse("dataset-replay", args=["cups", 1])))["videos"]
    assert (video["camera"], pictures["camera"]) == ("wrist/left", "hand/right")
    assert browser.get(video["address"]).status_code == 200
    assert browser.get(f"{pictures['address']}?row=0").status_code == 200


def test_what_is_not_there_is_named(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    for name, index, why in (
        ("plates", 0, "there is no dataset 'datasets/plates'"),
        ("cups", 3, "datasets/cups has no episode 3, there are 3"),
    ):
        answer = browser.get(reverse("dataset-replay", args=[name, index]))
        assert answer.status_code == 404
        assert why in answer.content.decode()
    assert (
        "has no camera 'front'; it has cam_high"
        in browser.get(reverse("dataset-picture", args=["cups", 0, "front"])).content.decode()
    )


@pytest.mark.parametrize(
    "name", ["../secret", "datasets/../../etc", ".hidden/x", "episodes/x", "a/b/c/d", "/etc"]
)
def test_no_name_leads_out_of_the_data_folder(browser: Client, data: Path, name: str) -> None:
    (data.parent / "secret" / "meta").mkdir(parents=True, exist_ok=True)
    (data.parent / "secret" / "meta" / "info.json").write_text("{}")
    answer = browser.get(f"/replay/datasets/{name}/-/0/curves")
    assert answer.status_code in (400, 404)
    assert b"secret" not in answer.content or b"names no dataset" in answer.content


def test_a_damaged_dataset_says_what_is_wrong(browser: Client, foreign: Foreign) -> None:
    folder = foreign("cups", version="v2.1")
    (folder / "data/chunk-000/episode_000001.parquet").write_bytes(b"PAR1")
    answer = browser.get(reverse("dataset-curves", args=["cups", 1]))
    assert answer.status_code == 409
    assert b"episode_000001.parquet" in answer.content
    assert browser.get(reverse("dataset-curves", args=["cups", 0])).status_code == 200


def test_a_person_can_say_whose_numbers_they_are(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    told = config(browser.get(reverse("dataset-replay", args=["cups", 0])))
    assert told["geometry"] == ""
    assert "calls its robot" in told["why"]
    told = config(browser.get(reverse("dataset-replay", args=["cups", 0]) + "?robot=ur5e"))
    assert told["geometry"].endswith("geometry?robot=ur5e")
    answer = browser.get(told["geometry"])  # six numbers, the UR5e of ours has a gripper too
    assert answer.status_code == 404
    assert b"the episode has 6 joints, ur5e has 7: choose another robot" in answer.content
    assert browser.get(reverse("dataset-replay", args=["cups", 0]) + "?robot=none").status_code == 404


# --- ours ----------------------------------------------------------------------------------------------------


@pytest.fixture
def ours(data: Path, journal: Callable[..., Path]) -> tuple[str, str]:
    """A published episode of ours, converted too: the names of both datasets' episode."""
    episode = journal(frames=20)
    publish(episode, data / "datasets" / "home", success=True)
    said = data / "said.jsonl"
    said.write_text(
        json.dumps(
            {
                "first": 2,
                "last": 5,
                "label": "reach",
                "milestone": "",
                "by": "ann",
                "at": "2026-01-01T00:00:00Z",
            }
        )
    )
    attach_sidecar(data / "datasets" / "home", episode.name, "annotations", said)
    convert(data / "datasets" / "home", data / "datasets" / "copy", "v3.0")
    return episode.name, "copy"


def test_what_travels_with_an_episode_of_ours_is_shown_in_both_versions(
    browser: Client, ours: tuple[str, str]
) -> None:
    for name in ("home", ours[1]):
        page = browser.get(reverse("dataset-replay", args=[name, 0]))
        told = config(page)
        (segment,) = browser.get(told["segments"]).json()["segments"]
        assert (segment["label"], segment["first"], segment["last"]) == ("reach", 2, 5)
        header = decode(browser.get(told["curves"]).content).header
        assert header["joints"] == list(JOINTS)
        assert ours[0] in page.content.decode()


def test_a_dataset_says_of_each_episode_what_is_known_of_it(browser: Client, ours: tuple[str, str]) -> None:
    station = Station.objects.create(name="bench", robot="small")
    Episode.objects.create(uuid=ours[0], station=station, frames=20)
    page = browser.get(reverse("dataset", args=["home"]))
    (row,) = page.context["page"]
    assert (row.success, row.result, row.verdict) == (True, "success", "")
    assert str(row.recording.uuid) == ours[0]
    assert list(browser.get(reverse("dataset", args=["home"]) + "?result=partial").context["page"]) == []
    assert len(browser.get(reverse("dataset", args=["home"]) + "?verdict=unreviewed").context["page"]) == 1
    assert list(browser.get(reverse("dataset", args=["home"]) + "?words=nothing+such").context["page"]) == []


# --- beside each other ---------------------------------------------------------------------------------------


def test_episodes_of_several_datasets_are_shown_beside_each_other(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    foreign("plates", version="v2.1")
    page = browser.get(
        reverse("side-by-side"), {"show": ["cups:0", "datasets/plates:2", "cups:0", "cups:9", "x"]}
    )
    assert page.status_code == 200
    assert [one["name"] for one in config(page)["episodes"]] == ["datasets/cups:0", "datasets/plates:2"]
    assert [one["frames"] for one in config(page)["episodes"]] == [6, 7]
    assert len(page.context["problems"]) == 2
    assert "no episode 9" in page.context["problems"][0]


def test_more_than_fit_are_refused(browser: Client, foreign: Foreign) -> None:
    foreign("cups")
    shown = [f"cups:{index}" for index in range(7)]
    assert browser.get(reverse("side-by-side"), {"show": shown}).status_code == 400


# --- the sample ----------------------------------------------------------------------------------------------


def test_the_sample_episode_is_replayed_with_its_robot(browser: Client, data: Path) -> None:
    given = os.environ.get("EVA_SAMPLE_EPISODE")
    if not given:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    (data / "datasets").mkdir()
    shutil.copytree(given, data / "datasets" / "sample")
    there, back = data / "datasets" / "there", data / "datasets" / "back"
    convert(data / "datasets" / "sample", there, "v3.0")
    convert(there, back, "v2.1")
    seen = []
    for name in ("sample", "there", "back"):
        told = config(browser.get(reverse("dataset-replay", args=[name, 0]) + "?robot=agilex_piper"))
        assert (told["frames"], told["fps"], len(told["videos"])) == (398, 30.0, 3)
        curves = browser.get(told["curves"]).content
        assert decode(curves).header["joints"][0] == "left_arm.joint0"
        poses = decode(browser.get(f"{told['poses']}&first=0").content).header
        assert (poses["rows"], poses["streams"]["poses"]["shape"][0]) == (398, MOST_ROWS)
        assert len(browser.get(told["geometry"]).json()["parts"]) == poses["streams"]["poses"]["shape"][1]
        seen.append((decode(curves).array("ticks", "measured"), decode(curves).array("ticks", "executed")))
    for measured, executed in seen[1:]:
        assert np.array_equal(measured, seen[0][0])
        assert np.array_equal(executed, seen[0][1])


def test_a_picture_of_a_dataset_that_is_far_too_large_is_refused_and_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    large = still_images.simplejpeg.encode_jpeg(still_images.np.zeros((48, 64, 3), "u1"))
    monkeypatch.setattr(still_images, "_stored", lambda *given: large)
    monkeypatch.setattr(still_images.Image, "MAX_IMAGE_PIXELS", 1000)
    episode: Any = SimpleNamespace(video=lambda camera: None, cameras={"top": "observation.images.top"})
    with pytest.raises(RecordingError, match=r"picture 3 of 'observation\.images\.top' cannot be decoded"):
        still_images.still_image(episode, "top", 3)
