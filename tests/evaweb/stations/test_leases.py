"""Leases: who gets a station, from whom, and how it ends."""

from __future__ import annotations

from datetime import timedelta

import pytest
from django.contrib.auth import get_user_model
from django.contrib.auth.models import User
from django.utils import timezone

from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.stations import leases
from evaweb.stations.lease_holders import holder_display_name
from evaweb.stations.models import Lease, LeaseRequest
from evaweb.stations.runtime_client import connection_to
from evaweb.stations.selectors import lease_open, request_list

pytestmark = pytest.mark.django_db


def held(runtime):
    return connection_to(runtime.name).status()["lease"]


def claim(user, station, page="p1"):
    return leases.claim(user=user, station=station, page=page)


def test_a_free_station_is_taken(live, runtime, ann):
    lease = claim(ann, live)
    assert (lease.holder, lease.user, lease.boot) == ("web:ann:p1", ann, runtime.boot)
    assert (held(runtime)["holder"], held(runtime)["epoch"]) == ("web:ann:p1", lease.epoch)
    assert lease_open(station=live) == lease


def test_claiming_again_keeps_the_lease(live, ann):
    assert claim(ann, live) == claim(ann, live)
    assert Lease.objects.count() == 1


def test_a_station_that_somebody_has_is_not_taken(live, ann, bob):
    claim(ann, live)
    with pytest.raises(Conflict, match="ann has Bench 1: ask for it"):
        claim(bob, live, "p2")
    with pytest.raises(Conflict, match="ann has Bench 1"):
        claim(ann, live, "another page of ann's")


def test_a_viewer_gets_no_lease(live, vera):
    for act in (leases.claim, leases.request_handover):
        with pytest.raises(NotAllowed, match="needs an operator"):
            act(user=vera, station=live, page="p1")


def test_a_station_that_is_switched_off_is_not_taken(live, ann):
    live.active, live.message = False, "gripper broken"
    with pytest.raises(NotAllowed, match="Bench 1 is switched off: gripper broken"):
        claim(ann, live)


def test_epochs_go_on_where_a_runtime_has_forgotten_them(live, runtime, ann):
    Lease.objects.create(station=live, holder="web:ann:old", epoch=40, ended_at=timezone.now())
    assert claim(ann, live).epoch == 41
    assert held(runtime)["epoch"] == 41


def test_a_lease_is_renewed_by_name_and_epoch_alone(live, runtime, ann, django_assert_num_queries):
    lease = claim(ann, live)
    with django_assert_num_queries(0):  # so does a web process that has just been started
        ack = leases.renew(username="ann", page="p1", station=live.name, epoch=lease.epoch)
        other = leases.renew(username="bob", page="p1", station=live.name, epoch=lease.epoch)
        old = leases.renew(username="ann", page="p1", station=live.name, epoch=lease.epoch - 1)
    assert (ack.status, ack.data["epoch"]) == ("accepted", lease.epoch)
    assert (other.status, old.status) == ("refused", "refused")
    assert "web:ann:p1 holds the lease" in other.reason


def test_giving_up_ends_row_and_lease(live, runtime, ann, bob):
    lease = claim(ann, live)
    leases.release(user=ann, station=live, page="p1")
    lease.refresh_from_db()
    assert lease.end_reason == "given up"
    assert held(runtime)["holder"] == ""
    assert claim(bob, live, "p2").epoch == lease.epoch + 1


def test_only_the_holding_page_gives_up(live, ann, bob):
    claim(ann, live)
    for user, page in ((bob, "p1"), (ann, "p9")):
        with pytest.raises(Conflict, match="this page does not have Bench 1"):
            leases.release(user=user, station=live, page=page)


def test_a_request_is_granted_with_the_next_epoch_and_no_gap(live, runtime, ann, bob):
    runtime.ready()
    mine = claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    assert list(request_list(station=live)) == [asked]
    theirs = leases.hand_over(user=ann, station=live, page="p1", request=asked.pk)
    mine.refresh_from_db()
    asked.refresh_from_db()
    assert (theirs.holder, theirs.epoch) == ("web:bob:p2", mine.epoch + 1)
    assert (mine.end_reason, asked.answer) == ("handed over to bob", LeaseRequest.Answer.GRANTED)
    assert held(runtime)["holder"] == "web:bob:p2"
    assert not request_list(station=live).exists()


def test_ones_own_lease_moves_to_another_page_with_the_next_epoch(live, runtime, ann):
    first = claim(ann, live)
    second = leases.move(user=ann, station=live, page="p2")
    first.refresh_from_db()
    assert (second.holder, second.epoch) == ("web:ann:p2", first.epoch + 1)
    assert first.end_reason == "moved to another page"
    assert (held(runtime)["holder"], held(runtime)["epoch"]) == ("web:ann:p2", second.epoch)
    assert leases.renew(username="ann", page="p1", station=live.name, epoch=first.epoch).status == "refused"


def test_a_lease_that_this_page_has_stays_where_it_is(live, ann):
    first = claim(ann, live)
    assert leases.move(user=ann, station=live, page="p1").epoch == first.epoch
    assert Lease.objects.count() == 1


def test_nobody_elses_lease_is_moved(live, runtime, ann, bob):
    with pytest.raises(Conflict, match="nobody has Bench 1, no other page of yours"):
        leases.move(user=bob, station=live, page="p2")
    claim(ann, live)
    an = get_user_model().objects.create_user("an")  # the name of one may begin that of another
    an.groups.set(ann.groups.all())
    for user in (bob, an):
        with pytest.raises(Conflict, match="ann has Bench 1, no other page of yours"):
            leases.move(user=user, station=live, page="p2")
    assert held(runtime)["holder"] == "web:ann:p1"


def test_a_station_that_is_switched_off_is_not_moved(live, runtime, ann):
    claim(ann, live)
    live.active = False
    with pytest.raises(NotAllowed, match="switched off"):
        leases.move(user=ann, station=live, page="p2")
    assert held(runtime)["holder"] == "web:ann:p1"


def test_asking_again_is_the_same_request_for_the_newer_page(live, ann, bob):
    claim(ann, live)
    first = leases.request_handover(user=bob, station=live, page="p2")
    again = leases.request_handover(user=bob, station=live, page="p3")
    assert again.pk == first.pk
    assert again.holder == "web:bob:p3"


def test_who_gets_a_station_has_got_what_they_asked_for(live, ann, bob):
    claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    leases.release(user=ann, station=live, page="p1")
    claim(bob, live, "p2")
    asked.refresh_from_db()
    assert asked.answer == LeaseRequest.Answer.GRANTED


def test_what_nobody_has_is_not_asked_for(live, bob):
    with pytest.raises(Conflict, match="Bench 1 has no operator: take it"):
        leases.request_handover(user=bob, station=live, page="p2")


def test_one_does_not_ask_oneself(live, ann):
    claim(ann, live)
    with pytest.raises(Conflict, match="this page has Bench 1 already"):
        leases.request_handover(user=ann, station=live, page="p1")


def test_a_request_is_withdrawn_or_declined_once(live, ann, bob):
    claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    assert leases.decline_request(user=ann, station=live, page="p1", request=asked.pk).answer == "declined"
    with pytest.raises(Conflict, match="the request of bob was declined already"):
        leases.hand_over(user=ann, station=live, page="p1", request=asked.pk)
    with pytest.raises(NotFound, match="bob has not asked"):
        leases.withdraw_request(user=bob, station=live)
    leases.request_handover(user=bob, station=live, page="p2")
    assert leases.withdraw_request(user=bob, station=live).answer == "withdrawn"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda bob: bob.groups.clear(), "bob is a viewer"),
        (lambda bob: User.objects.filter(pk=bob.pk).update(is_active=False), "bob is switched off"),
    ],
    ids=["a viewer now", "switched off"],
)
def test_who_may_not_command_any_more_is_not_handed_the_station(live, runtime, ann, bob, change, sentence):
    claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    change(bob)
    with pytest.raises(NotAllowed, match=sentence):
        leases.hand_over(user=ann, station=live, page="p1", request=asked.pk)
    assert held(runtime)["holder"] == "web:ann:p1"


def test_only_the_holder_hands_over(live, ann, bob):
    claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    with pytest.raises(Conflict, match="this page does not have"):
        leases.hand_over(user=bob, station=live, page="p2", request=asked.pk)


def test_a_lease_that_has_ended_is_not_handed_over(live, runtime, ann, bob):
    claim(ann, live)
    asked = leases.request_handover(user=bob, station=live, page="p2")
    leases._send_lease_command(live.name, "lease_give_up", "web:ann:p1", held(runtime)["epoch"])
    with pytest.raises(Conflict, match="the lease has ended: nobody has Bench 1 now"):
        leases.hand_over(user=ann, station=live, page="p1", request=asked.pk)


def test_an_administrator_takes_with_a_reason(live, runtime, ann, bob, alma):
    mine = claim(ann, live)
    with pytest.raises(NotAllowed, match="needs an admin"):
        leases.take_over(user=bob, station=live, page="p2", reason="mine")
    with pytest.raises(EvaError, match="needs a reason"):
        leases.take_over(user=alma, station=live, page="p3", reason="  ")
    taken = leases.take_over(user=alma, station=live, page="p3", reason="ann has gone home")
    mine.refresh_from_db()
    assert mine.end_reason == "taken by alma: ann has gone home"
    assert held(runtime)["holder"] == taken.holder == "web:alma:p3"


def notice(station, runtime, boot=None):
    return leases.record_snapshot_lease(station=station, boot=boot or runtime.boot, held=held(runtime))


def test_a_lease_that_expired_ends_its_row(make_stand_in, ann):
    from evaweb.stations.models import Station

    runtime = make_stand_in(ttl=0.05)
    station = Station.objects.create(name=runtime.name, robot="agilex_piper")
    lease = claim(ann, station)
    while held(runtime)["holder"]:
        pass
    assert notice(station, runtime)
    assert not notice(station, runtime)
    lease.refresh_from_db()
    assert lease.end_reason == "expired: it was not renewed"


def test_a_restart_ends_all_leases_before_it(live, runtime, ann):
    lease = claim(ann, live)
    runtime.end()
    runtime.boot_up()
    assert notice(live, runtime)
    lease.refresh_from_db()
    assert lease.end_reason == "the station was restarted"


def test_the_lease_of_a_terminal_is_written_down(live, runtime):
    leases._send_lease_command(live.name, "lease_claim", "terminal:eve@bench", 0, "operator")
    assert notice(live, runtime)
    lease = lease_open(station=live)
    assert (lease.holder, lease.user) == ("terminal:eve@bench", None)
    assert holder_display_name(lease.holder) == "terminal:eve@bench"


def test_a_terminal_that_took_a_free_station_ends_the_row_of_the_one_before(live, runtime, ann):
    mine = claim(ann, live)
    leases._send_lease_command(live.name, "lease_give_up", mine.holder, mine.epoch)
    leases._send_lease_command(live.name, "lease_claim", "terminal:eve@bench", 0, "operator")
    assert notice(live, runtime)
    mine.refresh_from_db()
    assert mine.end_reason == "expired: it was not renewed"
    assert lease_open(station=live).holder == "terminal:eve@bench"


def test_an_old_snapshot_ends_no_newer_lease(live, runtime, ann):
    before = held(runtime)
    lease = claim(ann, live)
    assert not leases.record_snapshot_lease(station=live, boot=runtime.boot, held=before)
    assert lease_open(station=live) == lease


def test_an_old_snapshot_revives_no_lease_that_was_given_up(live, runtime, ann):
    claim(ann, live)
    before = held(runtime)
    leases.release(user=ann, station=live, page="p1")
    assert not leases.record_snapshot_lease(station=live, boot=runtime.boot, held=before)
    assert lease_open(station=live) is None


def test_a_row_that_was_ended_wrongly_is_opened_again(live, runtime, ann):
    lease = claim(ann, live)
    Lease.objects.filter(pk=lease.pk).update(ended_at=timezone.now() - timedelta(minutes=1), end_reason="?")
    assert notice(live, runtime)
    assert lease_open(station=live) == lease
