from datetime import timedelta

import pytest
from django.utils import timezone

from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.plans import bench_checks as looking
from evaweb.plans import image_store
from evaweb.plans.models import Achieved, CameraCheck, Plan, Reference
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.trials import services as trials
from evaweb.trials import voids
from tests.evaweb.plans.lab import jpeg
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers

CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")


@pytest.fixture
def shown(monkeypatch):
    """What the cameras show, by their names."""
    found = {camera: jpeg(seed) for seed, camera in enumerate(CAMERAS)}
    monkeypatch.setattr(
        looking.image_store,
        "current_images",
        lambda station, cameras, patience_s=3.0: {c: found[c] for c in cameras},
    )
    monkeypatch.setattr(looking, "cameras_of", lambda station: list(CAMERAS))
    return found


@pytest.fixture
def plan(draft, owner):
    Plan.objects.filter(pk=draft.pk).update(match_gate=0.8)
    draft.refresh_from_db()
    return freeze_plan(user=owner, plan=draft)


def test_a_match_is_one_for_the_same_and_falls_with_what_differs():
    assert image_store.image_match(jpeg(1), jpeg(1)) == 1.0
    assert 0.9 < image_store.image_match(jpeg(1), jpeg(1, noise=40)) < 1.0
    assert image_store.image_match(jpeg(1), jpeg(2)) < 0.6
    flat = jpeg(1).__class__(image_store.simplejpeg.encode_jpeg(image_store.np.full((48, 64, 3), 90, "u1")))
    assert image_store.image_match(flat, jpeg(1)) == 0.0
    with pytest.raises(EvaError, match="no JPEG"):
        image_store.image_match(b"nothing", jpeg(1))


def test_a_picture_is_kept_once_under_its_digest():
    name = image_store.store_image(jpeg(3))
    assert image_store.store_image(jpeg(3)) == name
    assert image_store.load_image(name) == jpeg(3)
    with pytest.raises(NotFound, match="is not on this disk"):
        image_store.load_image("0" * 64)


def test_no_trial_is_handed_out_before_the_cameras_were_looked_at(bench, plan, shown):
    with pytest.raises(Conflict, match="confirm that each camera of bench-1 shows"):
        looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan)
    with pytest.raises(Conflict, match="cam_high, cam_left_wrist, cam_right_wrist: no reference picture yet"):
        looking.confirm_cameras(user=bench.operator, station=bench.station)
    check = looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    assert {facts["match"] for facts in check.seen.values()} == {1.0}
    assert Reference.objects.count() == 3
    shown["cam_left_wrist"], shown["cam_right_wrist"] = shown["cam_right_wrist"], shown["cam_left_wrist"]
    swapped = looking.confirm_cameras(user=bench.operator, station=bench.station)
    assert swapped.seen["cam_left_wrist"]["match"] < 0.6
    assert Reference.objects.count() == 3
    assert looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan).number == 1


def test_a_look_at_the_cameras_holds_for_who_looked_until_the_station_is_started_anew(bench, plan, shown):
    looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    assert looking.current_camera_check(user=bench.operator, station=bench.station)
    assert looking.current_camera_check(user=builders.user("bob"), station=bench.station) is None
    bench.station.boot = "boot-2"
    assert looking.current_camera_check(user=bench.operator, station=bench.station) is None
    bench.station.boot = builders.BOOT
    CameraCheck.objects.all()  # kept by the database: see test_services
    assert looking.current_camera_check(user=bench.operator, station=bench.station)


def test_a_bench_that_does_not_match_needs_a_reason_and_both_pictures_are_kept(bench, plan, shown):
    looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    trial = looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan).trial
    assert {row.match for row in looking.record_layout(user=bench.operator, trial=trial)} == {None}
    looking.record_references(user=bench.operator, station=bench.station, position=trial.position)
    shown["cam_high"] = jpeg(77)
    with pytest.raises(Conflict, match=r"cam_high -?0\.\d\d, wanted 0\.80"):
        looking.record_layout(user=bench.operator, trial=trial)
    looking.record_layout(user=bench.operator, trial=trial, override="the lamp is another one")
    row = Achieved.objects.filter(trial=trial, camera="cam_high").latest("pk")
    assert row.override == "the lamp is another one"
    assert row.match < 0.8
    assert image_store.load_image(row.picture) == jpeg(77)
    assert image_store.load_image(row.reference.picture) == jpeg(0)


def test_after_the_reveal_nothing_is_voided(bench, plan, owner, shown):
    looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    trial = looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial)
    trials.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, True, True))
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    with pytest.raises(EvaError, match="chosen with the result in view"):
        voids.void_trial(user=bench.operator, trial=trial, reason="it looks bad")


def test_a_look_that_is_old_is_made_again_before_the_run(bench, plan, shown):
    looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    trial = looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan).trial
    looking.record_references(user=bench.operator, station=bench.station, position=trial.position)
    looking.record_layout(user=bench.operator, trial=trial)
    shown["cam_high"] = jpeg(77)
    trials.run_checks("run", trial, bench.operator)  # seen a moment ago
    with without_triggers("plans"):
        Achieved.objects.update(at=timezone.now() - looking.LOOK_HOLDS - timedelta(seconds=1))
    with pytest.raises(Conflict, match="the bench is not as its reference shows: cam_high"):
        trials.run_checks("run", trial, bench.operator)
    looking.record_layout(user=bench.operator, trial=trial, override="the lamp is another one")
    trials.run_checks("run", trial, bench.operator)


# --- regions -------------------------------------------------------------------------------------------------


CORNER = {"name": "block", "x": 0.25, "y": 0.34, "width": 0.25, "height": 0.33}


@pytest.fixture
def laid(bench, plan, shown):
    """A trial that is prepared at a position with references, and the newest of them by camera."""
    looking.confirm_cameras(user=bench.operator, station=bench.station, first=True)
    trial = looking.allocate_checked_trial(user=bench.operator, station=bench.station, plan=plan).trial
    looking.record_references(user=bench.operator, station=bench.station, position=trial.position)
    return trial


def high(trial):
    return looking.references(station=trial.station, position=trial.position)["cam_high"]


def without_block(picture):
    """The same picture but for the region, which is of one grey."""
    pixels = image_store.simplejpeg.decode_jpeg(picture)
    pixels[78:166, 76:164] = 128
    return image_store.simplejpeg.encode_jpeg(pixels, quality=85)


def test_the_least_match_is_of_the_worst_region_and_each_is_kept(bench, laid, shown, client):
    user = bench.operator
    looking.save_regions(user=user, reference=high(laid), drawn=[CORNER, CORNER | {"name": "cup", "x": 0.7}])
    shown["cam_high"] = without_block(shown["cam_high"])
    assert image_store.image_match(jpeg(0), shown["cam_high"]) > 0.8  # the whole picture sees nothing of it
    with pytest.raises(
        Conflict, match=r"cam_high, block 0\.\d\d \(not recognised here or nearby\), wanted 0\.80"
    ):
        looking.record_layout(user=user, trial=laid)
    looking.record_layout(user=user, trial=laid, override="the block is lost")
    row = Achieved.objects.get(trial=laid, camera="cam_high")
    assert [(one["name"], one["match"] < 0.8) for one in row.regions] == [("block", True), ("cup", False)]
    assert row.match == image_store.image_match(jpeg(0), shown["cam_high"])
    assert row.reference.regions[0] == CORNER
    assert Achieved.objects.get(trial=laid, camera="cam_left_wrist").regions == []
    client.force_login(user)
    page = client.get(f"/result/trials/{laid.pk}/").content.decode()
    assert f"block {row.regions[0]['match']:.2f}, not recognised here or nearby" in page


def test_regions_that_match_let_a_run_begin_although_the_rest_of_the_picture_is_another(bench, laid, shown):
    looking.save_regions(user=bench.operator, reference=high(laid), drawn=[CORNER])
    pixels = image_store.simplejpeg.decode_jpeg(jpeg(0))
    pixels[:, 220:] = 255 - pixels[:, 220:]  # further away than anything that a region looks at
    shown["cam_high"] = image_store.simplejpeg.encode_jpeg(pixels, quality=85)
    assert image_store.image_match(jpeg(0), shown["cam_high"]) < 0.8
    assert len(looking.record_layout(user=bench.operator, trial=laid)) == 3


def test_regions_are_another_reference_and_stay_with_the_next_picture(bench, laid, shown):
    first = high(laid)
    drawn = looking.save_regions(user=bench.operator, reference=first, drawn=[CORNER])
    assert (first.regions, drawn.regions, drawn.picture) == ([], [CORNER], first.picture)
    with pytest.raises(Conflict, match="cam_high has a newer reference here, by ann"):
        looking.save_regions(user=bench.operator, reference=first, drawn=[])
    looking.record_references(user=bench.operator, station=bench.station, position=laid.position)
    assert high(laid).pk > drawn.pk
    assert high(laid).regions == [CORNER]
    looking.save_regions(user=bench.operator, reference=high(laid), drawn=[])
    assert high(laid).regions == []


def test_neither_picture_nor_regions_change_under_a_running_plan_that_has_judged_by_them(
    bench, laid, plan, owner
):
    looking.record_layout(user=bench.operator, trial=laid)
    before = high(laid)
    with pytest.raises(Conflict, match="is running and has judged trials by the reference of cam_high here"):
        looking.save_regions(user=bench.operator, reference=before, drawn=[CORNER])
    with pytest.raises(Conflict, match="is running and has judged trials by the reference of cam_"):
        looking.record_references(user=bench.operator, station=bench.station, position=laid.position)
    assert high(laid) == before
    builders.finished_trial(laid)
    trials.score_trial(user=bench.operator, trial=laid, milestones=bench.ticks(True, True, True))
    close_plan(user=owner, plan=plan, reason="enough")
    assert looking.save_regions(user=bench.operator, reference=high(laid), drawn=[CORNER]).regions == [CORNER]


def test_regions_are_operators_and_of_positions(bench, laid):
    with pytest.raises(NotAllowed):
        looking.save_regions(user=builders.user("vera", "viewer"), reference=high(laid), drawn=[CORNER])
    of_camera = looking.references(station=bench.station, position=None)["cam_high"]
    with pytest.raises(EvaError, match="allowed: regions of a position's"):
        looking.save_regions(user=bench.operator, reference=of_camera, drawn=[CORNER])
    with pytest.raises(EvaError, match="beyond the picture"):
        looking.save_regions(user=bench.operator, reference=high(laid), drawn=[CORNER | {"x": 0.9}])


def test_how_the_bench_lies_is_told_by_rest_and_the_page_draws_regions(bench, laid, shown, client):
    client.force_login(bench.operator)
    page = client.get(f"/references/{high(laid).pk}/").content.decode()
    assert f'"save": "/api/v1/references/{high(laid).pk}/regions"' in page
    address = f"/api/v1/references/{high(laid).pk}/regions"
    made = client.post(address, {"regions": [CORNER]}, content_type="application/json")
    assert (made.status_code, made.json()["regions"]) == (201, [CORNER])
    shown["cam_high"] = without_block(shown["cam_high"])
    seen = {one["camera"]: one for one in client.get(f"/api/v1/trials/{laid.pk}/bench").json()}
    (block,) = seen["cam_high"]["regions"]
    assert (block["name"], block["words"]) == ("block", "not recognised here or nearby")
    assert block["at"] == [CORNER[key] for key in ("x", "y", "width", "height")]
    assert seen["cam_left_wrist"]["regions"] == []
    assert Achieved.objects.count() == 0
    older = client.get(address.replace("/api/v1", "").replace("regions", "")).content.decode()
    assert "There is a newer one, which counts" in older
    assert "save-regions" not in older
    builders.finished_trial(laid)
    assert client.get(f"/api/v1/trials/{laid.pk}/bench").json() == []
