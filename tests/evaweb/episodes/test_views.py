"""Pages and files of episodes, as a browser asks for them."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from asgiref.sync import async_to_sync
from django.contrib.auth.models import Group, User
from django.test import AsyncClient, Client
from django.urls import reverse

import robots
from evaweb.core.binary_frames import decode
from evaweb.episodes import streaming
from evaweb.episodes.exports import FORMATS, KEPT_S, remove_old_mcap
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.jobs import services as jobs
from evaweb.jobs.models import Job
from evaweb.stations.models import Station
from runtime.recording.labels import Label, append_label

pytestmark = pytest.mark.django_db


@pytest.fixture
def user() -> User:
    made = User.objects.create_user("ann")
    made.groups.add(Group.objects.get_or_create(name="operator")[0])
    return made


@pytest.fixture
def browser(client: Client, user: User) -> Client:
    client.force_login(user)
    return client


Fetch = Callable[..., tuple[int, dict[str, str], bytes]]


@pytest.fixture
def fetch(user: User) -> Fetch:
    """Ask over ASGI, as daphne does: status, headers, all pieces together."""
    client = AsyncClient()
    client.force_login(user)

    async def ask(method: str, path: str, headers: dict[str, str]) -> tuple[int, dict[str, str], bytes]:
        answer = await client.generic(method, path, headers=headers)
        pieces = [piece async for piece in answer.streaming_content] if answer.streaming else [answer.content]
        return answer.status_code, dict(answer.headers), b"".join(pieces)

    def run(path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return async_to_sync(ask)(method, path, named)

    return run


def video_of(episode: Episode, camera: str = "cam_high") -> str:
    return reverse("episode-video", args=[episode.uuid, camera])


def file_of(episode: Episode, data: Path, camera: str = "cam_high") -> bytes:
    return (data / "previews" / str(episode.uuid) / f"{camera}.mp4").read_bytes()


# --- videos --------------------------------------------------------------------------------------------------


def test_a_whole_video_says_that_it_can_be_had_in_parts(previewed: Episode, data: Path, fetch: Fetch) -> None:
    content = file_of(previewed, data)
    status, headers, body = fetch(video_of(previewed))
    assert (status, body) == (200, content)
    assert headers["Accept-Ranges"] == "bytes"
    assert headers["Content-Type"] == "video/mp4"
    assert headers["Content-Length"] == str(len(content))
    assert headers["ETag"].startswith('"')
    assert headers["Last-Modified"].endswith("GMT")


@pytest.mark.parametrize(("asked", "first", "last"), [("10-19", 10, 20), ("-7", -7, None), ("5-", 5, None)])
def test_a_part_is_exactly_those_bytes(
    previewed: Episode, data: Path, fetch: Fetch, asked: str, first: int, last: int | None
) -> None:
    content = file_of(previewed, data)
    status, headers, body = fetch(video_of(previewed), Range=f"bytes={asked}")
    assert (status, body) == (206, content[first:last])
    begins = len(content) + first if first < 0 else first
    assert headers["Content-Range"] == f"bytes {begins}-{begins + len(body) - 1}/{len(content)}"
    assert headers["Content-Length"] == str(len(body))


def test_a_range_behind_the_end_is_refused_with_the_length(
    previewed: Episode, data: Path, fetch: Fetch
) -> None:
    size = len(file_of(previewed, data))
    status, headers, body = fetch(video_of(previewed), Range=f"bytes={size}-")
    assert (status, body) == (416, b"")
    assert headers["Content-Range"] == f"bytes */{size}"


@pytest.mark.parametrize("asked", ["bytes=5-2", "bytes=0-1,4-5", "frames=1-2"])
def test_what_is_no_single_range_gets_the_whole(
    previewed: Episode, data: Path, fetch: Fetch, asked: str
) -> None:
    status, _, body = fetch(video_of(previewed), Range=asked)
    assert (status, body) == (200, file_of(previewed, data))


def test_a_long_part_comes_in_pieces_and_ends_early_so_that_nothing_piles_up(
    previewed: Episode, data: Path, fetch: Fetch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "PIECE", 100)
    monkeypatch.setattr(streaming, "LONGEST_PART", 250)
    content = file_of(previewed, data)
    status, headers, body = fetch(video_of(previewed), Range="bytes=0-")
    assert (status, body) == (206, content[:250])
    assert headers["Content-Range"] == f"bytes 0-249/{len(content)}"
    assert fetch(video_of(previewed))[2] == content


def test_the_head_has_no_body_and_knows_no_ranges(previewed: Episode, data: Path, fetch: Fetch) -> None:
    status, headers, body = fetch(video_of(previewed), "HEAD", Range="bytes=0-5")
    assert (status, body) == (200, b"")
    assert headers["Content-Length"] == str(len(file_of(previewed, data)))


def test_a_browser_that_has_it_is_told_so(previewed: Episode, fetch: Fetch) -> None:
    _, headers, _ = fetch(video_of(previewed))
    assert fetch(video_of(previewed), If_None_Match=headers["ETag"])[0] == 304
    assert fetch(video_of(previewed), If_Modified_Since=headers["Last-Modified"])[0] == 304
    assert fetch(video_of(previewed), If_None_Match='"older"')[0] == 200


def test_a_part_of_an_older_version_gets_the_whole_of_the_new_one(
    previewed: Episode, data: Path, fetch: Fetch
) -> None:
    _, headers, _ = fetch(video_of(previewed))
    assert fetch(video_of(previewed), Range="bytes=0-3", If_Range=headers["ETag"])[0] == 206
    status, _, body = fetch(video_of(previewed), Range="bytes=0-3", If_Range='"older"')
    assert (status, body) == (200, file_of(previewed, data))


def test_nothing_can_be_written_there(previewed: Episode, fetch: Fetch) -> None:
    status, headers, _ = fetch(video_of(previewed), "PUT")
    assert status in (403, 405)
    assert "ETag" not in headers


@pytest.mark.parametrize(
    "camera",
    [
        "cam_low",
        "..%2F..%2Feva.sqlite3",
        "%2e%2e",
        "..",
        "../cam_high",
        "cam_high.mp4",
        "%00",
        "cam_high%00",
        "/etc/passwd",
    ],
)
def test_a_camera_that_the_row_does_not_name_never_reaches_the_disk(
    previewed: Episode, fetch: Fetch, camera: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []
    monkeypatch.setattr(streaming, "_open", opened.append)
    assert fetch(f"/episodes/{previewed.uuid}/video/{camera}")[0] == 404
    assert opened == []


@pytest.mark.some(7)
@pytest.mark.parametrize("identity", ["..", "%2e%2e", "not-a-uuid", "c86a888b"])
@pytest.mark.parametrize(
    "what", ["thumbnail", "video/cam_high", "sheet/cam_high", "curves", "poses", "bench", "export"]
)
def test_an_address_without_a_uuid_does_not_exist(fetch: Fetch, identity: str, what: str) -> None:
    assert fetch(f"/episodes/{identity}/{what}")[0] == 404


@pytest.mark.parametrize(
    "what", ["thumbnail", "video/cam_high", "sheet/cam_high", "curves", "poses", "bench", "export"]
)
def test_a_folder_that_the_database_does_not_know_is_not_shown(
    put: Callable[..., Path], fetch: Fetch, what: str
) -> None:
    folder = put()
    status, _, body = fetch(f"/episodes/{folder.name}/{what}")
    assert status == 404
    assert f"episode {folder.name} does not exist in this lab" in body.decode()


def test_a_video_that_is_not_there_is_named(closed: Callable[..., Episode], fetch: Fetch) -> None:
    status, _, body = fetch(video_of(closed()))
    assert status == 404
    assert "cam_high.mp4 of this episode is not on this machine" in body.decode()


@pytest.mark.parametrize("name", ["episode-thumbnail", "episode-curves", "episode-poses", "replay"])
def test_nobody_sees_an_episode_without_logging_in(previewed: Episode, client: Client, name: str) -> None:
    answer = client.get(reverse(name, args=[previewed.uuid]))
    assert answer.status_code == 302
    assert answer["Location"].startswith("/login/")


def test_the_thumbnail_is_a_picture(previewed: Episode, fetch: Fetch) -> None:
    status, headers, body = fetch(reverse("episode-thumbnail", args=[previewed.uuid]))
    assert (status, headers["Content-Type"], body[:2]) == (200, "image/jpeg", b"\xff\xd8")


def test_every_camera_has_a_sheet_of_small_pictures_and_an_older_preview_has_none(
    previewed: Episode, data: Path, fetch: Fetch, browser: Client
) -> None:
    address = reverse("episode-sheet", args=[previewed.uuid, "cam_high"])
    status, headers, body = fetch(address)
    assert (status, headers["Content-Type"], body[:2]) == (200, "image/jpeg", b"\xff\xd8")
    assert fetch(reverse("episode-sheet", args=[previewed.uuid, "cam_low"]))[0] == 404
    assert address in page_of(browser, previewed)
    (data / "previews" / str(previewed.uuid) / "cam_high.sheet.jpg").unlink()
    assert address not in page_of(browser, previewed)


# --- messages ------------------------------------------------------------------------------------------------


def test_curves_and_poses_are_messages(previewed: Episode, browser: Client) -> None:
    curves = decode(browser.get(reverse("episode-curves", args=[previewed.uuid])).content)
    assert curves.header["frames"] == previewed.frames
    poses = decode(browser.get(reverse("episode-poses", args=[previewed.uuid]), {"first": "20"}).content)
    assert poses.header["first"] == 20
    assert poses.array("poses").shape[0] == previewed.frames - 20


@pytest.mark.parametrize(("first", "status"), [("-1", 400), ("x", 400), ("9" * 12, 400), ("5000", 404)])
def test_a_row_that_is_none_is_refused(previewed: Episode, browser: Client, first: str, status: int) -> None:
    answer = browser.get(reverse("episode-poses", args=[previewed.uuid]), {"first": first})
    assert answer.status_code == status
    assert answer.json()["error"]


def test_a_damaged_journal_is_a_sentence_with_its_file(
    previewed: Episode, data: Path, browser: Client
) -> None:
    (data / "episodes" / str(previewed.uuid) / "manifest.json").write_text("{")
    answer = browser.get(reverse("episode-curves", args=[previewed.uuid]))
    assert answer.status_code == 409
    assert "manifest.json is not a whole JSON document" in answer.json()["error"]


# --- pages ---------------------------------------------------------------------------------------------------


def page_of(browser: Client, episode: Episode) -> str:
    answer = browser.get(reverse("replay", args=[episode.uuid]), headers={"Accept": "text/html"})
    assert answer.status_code == 200
    return answer.content.decode()


def test_the_page_has_a_video_for_each_camera_and_no_stop(previewed: Episode, browser: Client) -> None:
    page = page_of(browser, previewed)
    assert page.count("<video ") == 3
    for video in json.loads(
        page.partition('<script id="config" type="application/json">')[2].partition("<")[0]
    )["videos"]:
        assert f'<video src="{video["address"]}"' in page  # asked for before any script runs
    assert 'data-stage="ready"' in page
    assert "estop" not in page


def test_an_episode_with_one_camera_has_one_video(previewed: Episode, browser: Client) -> None:
    Episode.objects.update(cameras=["cam_high"])
    assert page_of(browser, previewed).count("<video ") == 1


def test_the_page_waits_for_the_preview_and_goes_on_by_itself(
    closed: Callable[..., Episode], browser: Client
) -> None:
    episode = closed()
    page = page_of(browser, episode)
    assert "The preview is being made" in page
    assert 'hx-trigger="every 1s"' in page
    address = reverse("replay-stage", args=[episode.uuid])
    assert "HX-Refresh" not in browser.get(address)
    jobs.run_queue("cpu")
    assert browser.get(address)["HX-Refresh"] == "true"


def test_an_episode_that_is_being_written_says_so(station: Station, data: Path, browser: Client) -> None:
    episode = Episode.objects.create(station=station)
    assert "This episode is still being written" in page_of(browser, episode)


def test_an_episode_whose_folder_is_gone_says_what_to_do(
    station: Station, data: Path, browser: Client
) -> None:
    episode = Episode.objects.create(station=station, status=EpisodeStatus.MISSING)
    assert "missing from the disk" in page_of(browser, episode)
    assert "manage.py reconcile" in page_of(browser, episode)


def test_a_preview_that_failed_is_asked_for_anew(
    closed: Callable[..., Episode], data: Path, browser: Client, user: User
) -> None:
    episode = closed()
    Job.objects.update(status="failed", error="cam_high.mp4 is cut off")
    assert "cam_high.mp4 is cut off" in page_of(browser, episode)
    address = reverse("replay-preview", args=[episode.uuid])
    assert browser.get(address).status_code == 405
    assert browser.post(address).status_code == 302
    assert Job.objects.filter(status="queued").count() == 1
    user.groups.clear()
    assert browser.post(address).status_code == 403


def test_an_unknown_episode_is_a_page_with_a_sentence(browser: Client) -> None:
    answer = browser.get(reverse("replay", args=[uuid.uuid4()]), headers={"Accept": "text/html"})
    assert answer.status_code == 404
    assert "does not exist in this lab" in answer.content.decode()


def test_an_empty_list_says_how_to_fill_it(db: Any, browser: Client) -> None:
    assert "Nothing has been recorded yet" in browser.get("/replay/").content.decode()


def test_the_list_shows_how_each_stands_and_looks_again_while_something_goes_on(
    previewed: Episode, station: Station, browser: Client
) -> None:
    page = browser.get("/replay/").content.decode()
    assert f'data-episode="{previewed.uuid}" data-stage="ready"' in page
    assert 'hx-trigger="every' not in page
    Episode.objects.create(station=station)
    page = browser.get("/replay/").content.decode()
    assert 'hx-trigger="every 3s"' in page
    rows = browser.get("/replay/", headers={"HX-Request": "true"}).content.decode()
    assert rows.startswith("<tbody")


@pytest.mark.some(2)
@pytest.mark.parametrize(
    ("query", "count"),
    [
        ({"words": "CUPS"}, 1),
        ({"words": "cups nowhere"}, 0),
        ({"station": "bench"}, 1),
        ({"status": "finished"}, 1),
        ({"status": "failed"}, 0),
        ({"mode": "continuous"}, 1),
        ({"mode": "sim"}, 0),
        ({"page": "99"}, 1),
        ({"page": "x"}, 1),
    ],
)
def test_the_list_is_filtered(previewed: Episode, browser: Client, query: dict[str, str], count: int) -> None:
    assert browser.get("/replay/", query).content.decode().count("data-episode=") == count


def test_what_the_list_does_not_know_is_named_and_all_is_shown(previewed: Episode, browser: Client) -> None:
    for query, said in (
        ({"station": "other"}, "station = &#x27;other&#x27;; allowed: bench"),
        ({"sort": "luck"}, "sort = &#x27;luck&#x27;; allowed: recorded, task, checkpoint"),
    ):
        page = browser.get("/replay/", query).content.decode()
        assert said in page
        assert page.count("data-episode=") == 1


def test_every_column_sorts_and_the_file_has_what_is_filtered(
    previewed: Episode, station: Station, browser: Client
) -> None:
    other = Episode.objects.create(station=station, status="failed", task="=later", duration_s=1e6)
    for name in (
        "recorded",
        "task",
        "checkpoint",
        "mode",
        "station",
        "result",
        "time",
        "recording",
        "dataset",
    ):
        for sort in (name, f"-{name}"):
            page = browser.get("/replay/", {"sort": sort}).content.decode()
            assert page.count("data-episode=") == 2
            assert page.count("aria-sort") == 1
    first = browser.get("/replay/", {"sort": "-time"}).content.decode().partition('data-episode="')[2]
    assert first.startswith(str(other.uuid))
    answer = browser.get("/replay/", {"format": "csv", "status": "failed"})
    lines = b"".join(answer.streaming_content).decode().splitlines()
    assert lines[0].startswith("recorded,task,checkpoint,mode,station,result,time")
    assert len(lines) == 2
    assert "'=later" in lines[1]
    assert str(other.uuid) in lines[1]


def test_who_only_looks_chooses_nothing(previewed: Episode, browser: Client, db: Any) -> None:
    assert "data-tick" in browser.get("/replay/").content.decode()
    visitor = Client()
    visitor.force_login(User.objects.create_user("visitor"))
    page = visitor.get("/replay/").content.decode()
    assert "data-tick" not in page
    assert "data-bulk" not in page


# --- the table -----------------------------------------------------------------------------------------------


def table_file(data: Path) -> Path:
    (path,) = (data / "exports").rglob("*.parquet")
    return path


def test_the_table_is_a_file_to_keep(previewed: Episode, data: Path, fetch: Fetch) -> None:
    status, headers, body = fetch(reverse("episode-export", args=[previewed.uuid]))
    assert (status, body) == (200, table_file(data).read_bytes())
    assert headers["Content-Type"] == "application/vnd.apache.parquet"
    assert headers["Content-Disposition"] == f'attachment; filename="{previewed.uuid}.parquet"'
    assert pq.read_table(pa.BufferReader(body)).num_rows > 3 * previewed.frames


def test_a_table_that_is_not_made_yet_is_made_on_demand(
    previewed: Episode, data: Path, browser: Client, fetch: Fetch, user: User
) -> None:
    path, address = table_file(data), reverse("episode-export", args=[previewed.uuid, "table"])
    content = path.read_bytes()
    path.unlink()
    status, _, body = fetch(address)
    assert status == 404
    assert "is not made yet: POST to this address has it made" in body.decode()
    page = page_of(browser, previewed)
    assert "Make the table" in page
    asked = browser.post(address).content.decode()
    assert "is being made" in asked
    assert f'hx-get="{reverse("episode-export-state", args=[previewed.uuid, "table"])}"' in asked
    assert jobs.run_queue("cpu") == 1
    assert fetch(address)[2] == content
    shown = browser.get(reverse("episode-export-state", args=[previewed.uuid, "table"])).content.decode()
    assert f'href="{address}"' in shown
    assert "hx-get" not in shown


def test_who_only_looks_downloads_a_table_but_has_none_made(
    previewed: Episode, data: Path, browser: Client, fetch: Fetch, user: User
) -> None:
    user.groups.clear()
    address = reverse("episode-export", args=[previewed.uuid])
    assert fetch(address)[0] == 200
    before = Job.objects.count()
    assert browser.post(address).status_code == 403
    assert Job.objects.count() == before


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "table"])
def test_an_mcap_file_is_made_on_demand_and_kept_for_a_day(
    name: str,
    previewed: Episode,
    data: Path,
    browser: Client,
    fetch: Fetch,
    settings: Any,
) -> None:
    settings.EVA_RESERVE_BYTES = 0
    address = reverse("episode-export", args=[previewed.uuid, name])
    assert fetch(address)[0] == 404
    assert "is being made" in browser.post(address).content.decode()
    assert jobs.run_queue("cpu") == 1
    status, headers, body = fetch(address)
    assert (status, body[:8]) == (200, b"\x89MCAP0\r\n")
    pictures = name.removeprefix("mcap-")
    assert headers["Content-Disposition"] == f'attachment; filename="{previewed.uuid}.{pictures}.mcap"'
    job = Job.objects.get(kind="mcap")
    assert (job.result["bytes"], job.result["file"]) == (len(body), f"mcap/{previewed.uuid}.{pictures}.mcap")
    append_label(data, str(previewed.uuid), Label(time.time(), "ann", "success"))
    assert fetch(address)[0] == 404  # the label is not in it
    browser.post(address)
    assert jobs.run_queue("cpu") == 1
    assert fetch(address)[0] == 200
    assert remove_old_mcap() == 0
    assert remove_old_mcap(time.time() + KEPT_S + 1.0) == 1
    assert fetch(address)[0] == 404


def test_an_mcap_file_leaves_the_room_that_recordings_need(
    previewed: Episode, data: Path, browser: Client, settings: Any
) -> None:
    settings.EVA_RESERVE_BYTES = 1 << 60
    browser.post(reverse("episode-export", args=[previewed.uuid, "mcap-video"]))
    jobs.run_queue("cpu")
    job = Job.objects.get(kind="mcap")
    assert "EVA_RESERVE_GB stays free" in job.error
    assert list((data / "mcap").iterdir()) == []


def test_a_format_that_does_not_exist_is_named(previewed: Episode, fetch: Fetch) -> None:
    status, _, body = fetch(reverse("episode-export", args=[previewed.uuid, "mcap-h265"]))
    assert (status, "mcap-image-h264" in body.decode()) == (404, True)


def test_a_table_that_cannot_be_made_says_why(previewed: Episode, data: Path, browser: Client) -> None:
    table_file(data).unlink()
    Job.objects.create(kind="export", key=f"export:{previewed.uuid}", status="failed", error="disk full")
    page = page_of(browser, previewed)
    assert "Failed: try again" in page
    assert "disk full" in page
    (data / "episodes" / str(previewed.uuid) / "manifest.json").write_text("{")
    assert "manifest.json is not a whole JSON document" in page_of(browser, previewed)


def test_an_episode_that_is_being_written_has_no_table(station: Station, data: Path, browser: Client) -> None:
    episode = Episode.objects.create(station=station)
    shown = browser.get(reverse("episode-export-state", args=[episode.uuid, "table"])).content.decode()
    assert "href" not in shown
    assert "button" not in shown


# --- modes ---------------------------------------------------------------------------------------------------


def test_the_list_and_the_page_say_in_which_mode_it_was(previewed: Episode, browser: Client) -> None:
    assert (previewed.mode, previewed.strategy) == ("continuous", "async")
    Episode.objects.update(mode="sim")
    for page in (browser.get("/replay/").content.decode(), page_of(browser, previewed)):
        assert 'data-mode="sim">simulated robot</span>' in page


def test_the_page_says_how_late_the_policy_was(previewed: Episode, browser: Client) -> None:
    assert previewed.policy["answers"] > 0
    spread = {"p50": 3.0, "p90": 4.0, "p99": 5.0, "max": 6.0}
    figures = {"answers": 40, "mistimed": 2, "dropped": 0, "delay_steps": spread, "latency_ms": spread}
    Episode.objects.update(policy=figures)
    page = page_of(browser, previewed)
    assert "3 steps" in page
    assert "at most 6, n = 40" in page
    assert "2 mistimed</span>" in page
    Episode.objects.update(policy={})
    assert "Delay" not in page_of(browser, previewed)


# --- the robot -----------------------------------------------------------------------------------------------


def test_the_robot_is_drawn_in_the_groups_that_were_recorded(
    previewed: Episode, data: Path, browser: Client
) -> None:
    address = reverse("episode-geometry", args=[previewed.uuid])
    assert f'"geometry": "{address}"' in page_of(browser, previewed)
    assert browser.get(address).json()["groups"] == ["left_arm", "right_arm"]
    path = data / "episodes" / str(previewed.uuid) / "manifest.json"
    whole = json.loads(path.read_text())
    one = robots.load_robot("agilex_piper", ["right_arm"])
    whole["robot"] |= {"dim": one.dim, "joint_names": list(one.joint_names)}
    path.write_text(json.dumps(whole))
    assert browser.get(address).json()["groups"] == ["right_arm"]
    path.write_text(json.dumps(whole | {"robot": whole["robot"] | {"name": "retired"}}))
    refused = browser.get(address)
    assert (refused.status_code, "'retired' does not exist" in refused.content.decode()) == (404, True)
    path.write_text("{")
    assert browser.get(address).status_code == 409
    assert Client().get(address).status_code == 302
