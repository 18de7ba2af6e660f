"""Computers that become stations: codes, keys, and who may connect."""

from __future__ import annotations

import fcntl
import json
import threading
from datetime import timedelta

import pytest
from django.db import OperationalError
from django.urls import reverse
from django.utils import timezone

from evaweb.core.environment import address
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.stations import enrolment, gate
from evaweb.stations.models import EnrolmentCode, Station, StationKey
from runtime.link import codes, key_files
from runtime.link.admission import Allowed

pytestmark = pytest.mark.django_db
KEY, OTHER = "ab" * 32, "cd" * 32


@pytest.fixture
def bench():
    return Station.objects.create(name="bench-7", robot="agilex_piper")


@pytest.fixture(autouse=True)
def _a_gate(settings, tmp_path):
    settings.EVA_GATE, settings.EVA_GATE_NAME = ("0.0.0.0", 8470), "lab.example.org"
    settings.DATA_DIR = tmp_path


def enrolled(user, station, key=KEY):
    shown = enrolment.code_make(user=user, station=station)
    digest = codes.digest(codes.read(shown.code).secret)
    return enrolment.key_enrol(digest=digest, key=key, computer="robot-pc")


def test_a_code_holds_the_labs_key_and_the_database_a_digest_alone(alma, bench):
    shown = enrolment.code_make(user=alma, station=bench)
    code = codes.read(shown.code)
    assert code.lab == key_files.lab_key(enrolment.settings.DATA_DIR).public
    assert (shown.address, shown.second_port) == ("lab.example.org:8470", 8471)
    assert shown.fingerprint == codes.fingerprint(code.lab)
    (row,) = EnrolmentCode.objects.all()
    assert row.digest == codes.digest(code.secret)


def test_a_code_is_good_once_and_names_its_station(alma, bench):
    shown = enrolment.code_make(user=alma, station=bench)
    digest = codes.digest(codes.read(shown.code).secret)
    assert enrolment.key_enrol(digest=digest, key=KEY, computer="robot-pc") == bench
    with pytest.raises(Conflict, match="not known, was used, or is too old"):
        enrolment.key_enrol(digest=digest, key=OTHER, computer="another")
    assert enrolment.keys_allowed().stations == {KEY: frozenset({"bench-7"})}


def test_a_code_that_is_too_old_or_made_up_lets_nobody_in(alma, bench):
    shown = enrolment.code_make(user=alma, station=bench)
    EnrolmentCode.objects.update(expires_at=timezone.now() - timedelta(seconds=1))
    for secret in (codes.read(shown.code).secret, bytes(10)):
        with pytest.raises(Conflict):
            enrolment.key_enrol(digest=codes.digest(secret), key=KEY, computer="")
    assert enrolment.keys_allowed().stations == {}
    assert not enrolment.keys_allowed().enrolling


def test_a_second_code_of_a_station_takes_the_place_of_the_first(alma, bench):
    first = enrolment.code_make(user=alma, station=bench)
    enrolment.code_make(user=alma, station=bench)
    with pytest.raises(Conflict):
        enrolment.key_enrol(digest=codes.digest(codes.read(first.code).secret), key=KEY, computer="")


def test_unknown_keys_may_connect_as_long_as_a_code_is_open(alma, bench):
    assert not enrolment.keys_allowed().may_connect(OTHER)
    enrolment.code_make(user=alma, station=bench)
    assert enrolment.keys_allowed().may_connect(OTHER)
    assert not enrolment.keys_allowed().may_be(OTHER, "bench-7")


def test_a_key_is_replaced_by_enrolling_again(alma, bench):
    enrolled(alma, bench)
    enrolled(alma, bench, OTHER)
    assert enrolment.keys_allowed().stations == {OTHER: frozenset({"bench-7"})}
    assert StationKey.objects.get(key=KEY).withdrawn == "replaced by another computer or key"
    enrolled(alma, bench, OTHER)
    assert StationKey.objects.filter(withdrawn_at=None).count() == 1


def test_one_computer_may_be_several_stations(alma, bench):
    second = Station.objects.create(name="bench-8", robot="agilex_piper")
    enrolled(alma, bench)
    enrolled(alma, second)
    assert enrolment.keys_allowed().stations == {KEY: frozenset({"bench-7", "bench-8"})}


def test_a_key_that_is_withdrawn_may_connect_no_more_and_stays_as_a_record(alma, bench):
    enrolled(alma, bench)
    enrolment.key_withdraw(user=alma, key=bench.keys.get())
    assert enrolment.keys_allowed().stations == {}
    assert bench.keys.get().withdrawn == "withdrawn by alma"


def test_codes_and_keys_are_an_administrators(ann, alma, bench):
    with pytest.raises(NotAllowed):
        enrolment.code_make(user=ann, station=bench)
    enrolled(alma, bench)
    with pytest.raises(NotAllowed):
        enrolment.key_withdraw(user=ann, key=bench.keys.get())
    assert enrolment.keys_allowed().may_be(KEY, "bench-7")


def test_a_lab_without_a_gate_says_how_it_gets_one(alma, bench, settings):
    settings.EVA_GATE = None
    with pytest.raises(EvaError, match="EVA_GATE=HOST:PORT"):
        enrolment.code_make(user=alma, station=bench)


def test_the_administration_shows_a_code_once_and_withdraws_a_key(client, alma, bench):
    client.force_login(alma)
    page = reverse("admin:stations_station_enrol", args=[bench.pk])
    assert page in client.get(reverse("admin:stations_station_change", args=[bench.pk])).content.decode()
    assert not EnrolmentCode.objects.exists()
    assert "runtime.keys enrol" not in client.get(page).content.decode()
    shown = client.post(page).content.decode()
    assert "python -m runtime.keys enrol lab.example.org:8470 " in shown
    assert "Show a code" in client.get(page).content.decode()
    enrolled(alma, bench)
    assert "robot-pc is bench-7 since" in client.get(page).content.decode()
    listed = reverse("admin:stations_stationkey_changelist")
    chosen = {"action": "withdraw", "_selected_action": [bench.keys.get().pk]}
    assert client.post(listed, chosen, follow=True).status_code == 200
    assert bench.keys.get().withdrawn == "withdrawn by alma"


def test_the_page_of_a_code_is_an_administrators(client, ann, bench):
    client.force_login(ann)
    assert client.post(reverse("admin:stations_station_enrol", args=[bench.pk])).status_code == 302
    assert not EnrolmentCode.objects.exists()


def test_who_may_connect_is_kept_for_a_gate_that_starts_without_a_database(
    alma, bench, tmp_path, monkeypatch
):
    enrolled(alma, bench)
    keys = gate.Keys(tmp_path)
    assert keys.list.now.may_be(KEY, "bench-7")
    kept = json.loads((tmp_path / "link" / "allowed.json").read_text())
    assert kept == {KEY: ["bench-7"]}

    def away():
        raise OperationalError("the database is away")

    monkeypatch.setattr(gate, "keys_allowed", away)
    keys.poll()
    assert keys.list.now.may_be(KEY, "bench-7")
    assert gate.Keys(tmp_path).list.now.may_be(KEY, "bench-7")


@pytest.mark.parametrize("content", ["", "[]", '{"a": 1}', '{"a": "b"'])
def test_a_list_that_cannot_be_read_lets_nobody_in(tmp_path, content, monkeypatch):
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "allowed.json").write_text(content)
    monkeypatch.setattr(gate, "keys_allowed", lambda: (_ for _ in ()).throw(OperationalError("away")))
    assert gate.Keys(tmp_path).list.now.stations == {}


@pytest.mark.parametrize(
    ("given", "read"),
    [("", None), ("0.0.0.0:8470", ("0.0.0.0", 8470)), ("[::]:8470", ("::", 8470)), ("lab:1", ("lab", 1))],
)
def test_the_address_of_a_gate_is_read(monkeypatch, given, read):
    monkeypatch.setenv("EVA_GATE", given)
    assert address("EVA_GATE") == read


def test_who_may_connect_is_followed_after_a_fault_that_nobody_foresaw(tmp_path, monkeypatch):
    """Else a key that is withdrawn later is let in for as long as the process lives."""
    monkeypatch.setattr(gate, "_LOOK_S", 0.0)
    monkeypatch.setattr(gate, "keys_allowed", Allowed)
    keys, ended, said = gate.Keys(tmp_path), threading.Event(), [Allowed(enrolling=True), 1 / 2]

    def found():
        if isinstance(one := said.pop(), Allowed):
            ended.set()
            return one
        raise ValueError("nobody foresaw it")

    monkeypatch.setattr(gate, "keys_allowed", found)
    keys.follow(ended)
    assert keys.list.now.enrolling


def test_a_second_gate_of_a_data_folder_does_not_start(tmp_path):
    key_files.lab_key(tmp_path)
    with (key_files.folder(tmp_path) / "gate.lock").open("a+") as first:
        first.write("4711")
        first.flush()
        fcntl.flock(first, fcntl.LOCK_EX)
        with pytest.raises(gate.GateError, match=r"is already running \(process 4711\): end it first"):
            gate.serve(("127.0.0.1", 0, 0), False, lambda uuid: "", lambda digest: None)
