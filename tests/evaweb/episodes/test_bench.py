"""What a simulated bench said in a recording: where things lay, what was reached, and who may hear of that."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
from django.contrib.auth.models import User
from django.test import Client
from django.urls import reverse

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.binary_frames import decode
from evaweb.episodes import services
from evaweb.episodes.bench import bench_course
from evaweb.episodes.curves import curve_message
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import unscored_for
from evaweb.stations.models import Station
from runtime.recording.reader import open_episode
from runtime.recording.tables import write_table

HELD_ROWS = 6  # from row 12 on or so
LIES = {"blocks": [[0.1, 0.2, 0.02, 0.0]], "plate": [0.3, 0.1]}
HELD = {"blocks": [[0.1, 0.2, 0.06, 0.0]], "plate": [0.3, 0.1]}
SAID = {
    0: {**LIES, "milestones": {"grasped": False}},
    5: {**HELD, "milestones": {"grasped": True}},
    9: {**HELD, "milestones": {"grasped": True, "over_plate": True}},
}


@pytest.fixture
def simulated(put: Callable[..., Path]) -> Path:
    """The recording as a simulated bench would have left it."""
    folder = put()
    rows = open_episode(folder).rows
    said = [json.dumps(SAID[row]) if row in SAID else None for row in range(rows.num_rows)]
    column = rows.schema.get_field_index("bench")
    write_table(folder / "rows.arrow", rows.set_column(column, "bench", pa.array(said, pa.string())))
    return folder


def milestones(folder: Path, **given: object) -> list[tuple[float, str]]:
    marks = decode(curve_message(folder, **given)).header["marks"]  # type: ignore[arg-type]
    return [(mark["time"], mark["text"]) for mark in marks if mark["kind"] == "milestone"]


def test_the_course_says_where_things_lay_and_nothing_of_what_was_reached(simulated: Path) -> None:
    assert bench_course(simulated) == [{"row": 0, **LIES}, {"row": 5, **HELD}]


def test_a_recording_of_no_simulated_bench_has_no_course(put: Callable[..., Path]) -> None:
    assert bench_course(put()) == []


def test_milestones_are_marked_when_the_bench_says_so_and_as_they_were_scored_where_they_were(
    simulated: Path,
) -> None:
    fps = open_episode(simulated).layout.fps
    told = [(5 / fps, "reached: grasped"), (9 / fps, "reached: over plate")]
    assert milestones(simulated) == [(pytest.approx(time), words) for time, words in told]
    scored = milestones(simulated, milestones=[(10 / fps, "lifted"), (15 / fps, "placed")])
    assert scored == [
        (pytest.approx(10 / fps), "reached: lifted"),
        (pytest.approx((15 + HELD_ROWS) / fps), "reached: placed"),  # the run stood still while it was held
    ]
    assert milestones(simulated, unscored=True) == []


def test_whoever_is_blind_hears_how_it_went_after_scoring_alone(db: None, simulated: Path) -> None:
    truth = {"kind": "truth", "text": "the simulated bench says: success", "time": 1.0}
    with (simulated / "events.jsonl").open("a") as events:
        events.write(json.dumps(truth) + "\n")

    def hears(**given: bool) -> bool:
        marks = decode(curve_message(simulated, **given)).header["marks"]
        return any(mark["kind"] == "truth" for mark in marks)

    assert hears()
    assert hears(covered=True)
    assert not hears(covered=True, unscored=True)
    blind = Visibility(checkpoints=frozenset({1}), names=frozenset({"secret"}))
    hidden = Episode(uuid=uuid.uuid4(), checkpoint="secret")
    assert unscored_for(episode=hidden, sight=blind)
    assert not unscored_for(episode=hidden, sight=FULL_VISIBILITY)


def test_the_address_of_the_course_is_for_everybody_who_is_logged_in(
    simulated: Path, station: Station, client: Client
) -> None:
    data = {"uuid": simulated.name, "status": "finished"}
    episode = services.record_closed(station=station, data=data)
    address = reverse("episode-bench", args=[episode.uuid])
    assert client.get(address).status_code == 302
    client.force_login(User.objects.create_user("viewer"))
    assert [change["row"] for change in client.get(address).json()["course"]] == [0, 5]
