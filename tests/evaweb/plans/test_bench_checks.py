import pytest

from evaweb.errors import Conflict, EvaError, NotFound
from evaweb.plans import bench_checks as looking
from evaweb.plans import pictures
from evaweb.plans.models import Achieved, CameraCheck, Plan, Reference
from evaweb.plans.services import plan_close, plan_freeze, plan_reveal
from evaweb.trials import services as trials
from evaweb.trials import voids
from tests.evaweb.plans.lab import jpeg
from tests.evaweb.trials import builders

CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")


@pytest.fixture
def shown(monkeypatch):
    """What the cameras show, by their names."""
    found = {camera: jpeg(seed) for seed, camera in enumerate(CAMERAS)}
    monkeypatch.setattr(looking.pictures, "now", lambda station, cameras: {c: found[c] for c in cameras})
    monkeypatch.setattr(looking, "cameras_of", lambda station: list(CAMERAS))
    return found


@pytest.fixture
def plan(draft, owner):
    Plan.objects.filter(pk=draft.pk).update(match_gate=0.8)
    draft.refresh_from_db()
    return plan_freeze(user=owner, plan=draft)


def test_a_match_is_one_for_the_same_and_falls_with_what_differs():
    assert pictures.match(jpeg(1), jpeg(1)) == 1.0
    assert 0.9 < pictures.match(jpeg(1), jpeg(1, noise=40)) < 1.0
    assert pictures.match(jpeg(1), jpeg(2)) < 0.6
    flat = jpeg(1).__class__(pictures.simplejpeg.encode_jpeg(pictures.np.full((48, 64, 3), 90, "u1")))
    assert pictures.match(flat, jpeg(1)) == 0.0
    with pytest.raises(EvaError, match="no JPEG"):
        pictures.match(b"nothing", jpeg(1))


def test_a_picture_is_kept_once_under_its_digest():
    name = pictures.keep(jpeg(3))
    assert pictures.keep(jpeg(3)) == name
    assert pictures.kept(name) == jpeg(3)
    with pytest.raises(NotFound, match="is not on this disk"):
        pictures.kept("0" * 64)


def test_no_trial_is_handed_out_before_the_cameras_were_looked_at(bench, plan, shown):
    with pytest.raises(Conflict, match="confirm that each camera of bench-1 shows"):
        looking.next_trial(user=bench.operator, station=bench.station, plan=plan)
    with pytest.raises(Conflict, match="cam_high, cam_left_wrist, cam_right_wrist: no reference picture yet"):
        looking.cameras_confirm(user=bench.operator, station=bench.station)
    check = looking.cameras_confirm(user=bench.operator, station=bench.station, first=True)
    assert {facts["match"] for facts in check.seen.values()} == {1.0}
    assert Reference.objects.count() == 3
    shown["cam_left_wrist"], shown["cam_right_wrist"] = shown["cam_right_wrist"], shown["cam_left_wrist"]
    swapped = looking.cameras_confirm(user=bench.operator, station=bench.station)
    assert swapped.seen["cam_left_wrist"]["match"] < 0.6
    assert Reference.objects.count() == 3
    assert looking.next_trial(user=bench.operator, station=bench.station, plan=plan).number == 1


def test_a_look_at_the_cameras_holds_for_who_looked_until_the_station_is_started_anew(bench, plan, shown):
    looking.cameras_confirm(user=bench.operator, station=bench.station, first=True)
    assert looking.cameras_confirmed(user=bench.operator, station=bench.station)
    assert looking.cameras_confirmed(user=builders.user("bob"), station=bench.station) is None
    bench.station.boot = "boot-2"
    assert looking.cameras_confirmed(user=bench.operator, station=bench.station) is None
    bench.station.boot = builders.BOOT
    CameraCheck.objects.all()  # kept by the database: see test_services
    assert looking.cameras_confirmed(user=bench.operator, station=bench.station)


def test_a_bench_that_does_not_match_needs_a_reason_and_both_pictures_are_kept(bench, plan, shown):
    looking.cameras_confirm(user=bench.operator, station=bench.station, first=True)
    trial = looking.next_trial(user=bench.operator, station=bench.station, plan=plan).trial
    assert {row.match for row in looking.achieve(user=bench.operator, trial=trial)} == {None}
    looking.references_take(user=bench.operator, station=bench.station, position=trial.position)
    shown["cam_high"] = jpeg(77)
    with pytest.raises(Conflict, match=r"cam_high -?0\.\d\d, wanted 0\.80"):
        looking.achieve(user=bench.operator, trial=trial)
    looking.achieve(user=bench.operator, trial=trial, override="the lamp is another one")
    row = Achieved.objects.filter(trial=trial, camera="cam_high").latest("pk")
    assert row.override == "the lamp is another one"
    assert row.match < 0.8
    assert pictures.kept(row.picture) == jpeg(77)
    assert pictures.kept(row.reference.picture) == jpeg(0)


def test_after_the_reveal_nothing_is_voided(bench, plan, owner, shown):
    looking.cameras_confirm(user=bench.operator, station=bench.station, first=True)
    trial = looking.next_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.over(trial)
    trials.trial_score(user=bench.operator, trial=trial, milestones=bench.ticks(True, True, True))
    plan_close(user=owner, plan=plan, reason="enough")
    plan_reveal(user=owner, plan=plan)
    with pytest.raises(EvaError, match="chosen with the result in view"):
        voids.trial_void(user=bench.operator, trial=trial, reason="it looks bad")
