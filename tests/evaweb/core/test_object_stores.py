"""Objects by their digests in both places: a folder, and a bucket of a real S3 server."""

from __future__ import annotations

import hashlib
import os
import random
import time
import urllib.error
import urllib.request
from urllib.parse import parse_qs, urlsplit

import pytest
from django.core.exceptions import ImproperlyConfigured

from evaweb.core import environment, object_stores
from evaweb.core.object_stores import (
    FolderStore,
    LocalCache,
    S3Store,
    StoreError,
    compared,
)
from tests.evaweb.s3_server import KEY, SECRET, Server, why_no_server

CONTENT = random.Random(1).randbytes(6_000_000)  # more than one part of an upload
DIGEST = hashlib.sha256(CONTENT).hexdigest()
NONE = "00" * 32


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    if why := why_no_server():
        pytest.skip(why)
    made = Server(tmp_path_factory.mktemp("server"))
    yield made
    made.close()


@pytest.fixture(params=["folder", "s3"])
def store(request, tmp_path):
    if request.param == "folder":
        (tmp_path / "store").mkdir()
        return FolderStore(tmp_path / "store")
    return S3Store(request.getfixturevalue("server").bucket(prefix=tmp_path.name))


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "front.mp4"
    path.write_bytes(CONTENT)
    return path


def test_what_is_put_is_found_by_its_digest_and_can_be_removed(store, video):
    assert not store.exists(DIGEST)
    assert [store.put(video, "video/mp4") for _ in range(2)] == [DIGEST, DIGEST]
    assert store.exists(DIGEST)
    assert b"".join(store.read(DIGEST)) == CONTENT
    compared(store, DIGEST)
    store.delete(DIGEST)
    store.delete(DIGEST)
    assert not store.exists(DIGEST)
    with pytest.raises(StoreError, match=f"does not give {DIGEST}"):
        list(store.read(DIGEST))


def test_the_cache_brings_what_is_wanted_once_and_compares_it(store, video, tmp_path):
    cache = LocalCache(tmp_path / "cache", 10**9)
    store.put(video, "video/mp4")
    path = cache.get(store, DIGEST)
    assert path.read_bytes() == CONTENT
    assert cache.get(store, DIGEST) == path
    if store.file(NONE) is None:
        with pytest.raises(StoreError, match="does not give"):
            cache.get(store, NONE)
        assert not list((tmp_path / "cache").glob(".draft*"))


def test_what_a_killed_process_left_in_a_store_goes_after_a_day(video, tmp_path):
    (drafts := tmp_path / "store" / ".drafts").mkdir(parents=True)
    ages = {".draft-old": 25.0, ".draft-under-way": 23.0}
    for name, hours in ages.items():
        (drafts / name).touch()
        os.utime(drafts / name, (time.time() - 3600.0 * hours,) * 2)
    FolderStore(tmp_path / "store").put(video, "video/mp4")
    assert [path.name for path in drafts.iterdir()] == [".draft-under-way"]


@pytest.mark.exhaustive
def test_a_bucket_whose_object_was_changed_is_not_believed(server, video, tmp_path):
    store = S3Store(server.bucket(prefix="changed"))
    store.put(video, "video/mp4")
    (server.folder / "lab" / "changed" / DIGEST[:2] / DIGEST).write_bytes(b"another")
    with pytest.raises(StoreError, match="is not what its name says"):
        LocalCache(tmp_path / "cache", 10**9).get(store, DIGEST)
    with pytest.raises(StoreError, match="is not what its name says"):
        compared(store, DIGEST)
    assert [path for path in (tmp_path / "cache").rglob("*") if path.is_file()] == []


def test_a_signed_address_gives_the_object_to_whoever_has_it_and_to_nobody_without(server, video):
    store = S3Store(server.bucket())
    store.put(video, "video/mp4")
    address = store.address(DIGEST)
    with urllib.request.urlopen(address) as answer:
        assert answer.read() == CONTENT
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(address.partition("?")[0])
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(address.replace(DIGEST[-6:], "000000"))
    assert SECRET not in address


@pytest.mark.parametrize(("asked", "given"), [(60, "60"), (300, "300"), (86400, "300")])
def test_no_address_is_good_for_more_than_five_minutes(server, asked, given):
    address = S3Store(server.bucket()).address(DIGEST, asked)
    assert parse_qs(urlsplit(address).query)["X-Amz-Expires"] == [given]


@pytest.mark.parametrize("endpoint", ["", "https://s3.example.org:9000"])
def test_pages_are_allowed_the_origin_that_addresses_have(endpoint):
    pytest.importorskip("obstore")
    bucket = environment.Bucket("lab", "eva", endpoint, "eu-north-1", KEY, SECRET)
    assert S3Store(bucket).address(DIGEST).startswith(f"{bucket.origin}/lab/eva/{DIGEST[:2]}/{DIGEST}?")


def test_a_wrong_key_and_a_server_that_is_away_are_sentences(server, video, monkeypatch):
    with pytest.raises(StoreError, match="the store s3://lab/eva does not say whether it has"):
        S3Store(server.bucket(secret="wrong")).put(video, "video/mp4")
    monkeypatch.setattr(object_stores, "_RETRIES", {"max_retries": 0})
    away = environment.Bucket("lab", "", "http://127.0.0.1:1", "us-east-1", KEY, SECRET)
    with pytest.raises(StoreError, match="the store s3://lab does not say whether it has") as refused:
        S3Store(away).put(video, "video/mp4")
    assert SECRET not in str(refused.value)


def test_a_folder_that_is_not_there_any_more_is_a_sentence(tmp_path, video):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StoreError, match="file does not take a file: Not a directory"):
        FolderStore(tmp_path / "file").put(video, "video/mp4")


def test_a_cache_keeps_what_was_used_last_and_never_takes_away_what_is_in_use(tmp_path):
    class Remote(FolderStore):
        def file(self, digest):
            return None

    (tmp_path / "store").mkdir()
    store, cache = Remote(tmp_path / "store"), LocalCache(tmp_path / "cache", 250)
    digests = []
    for seed in range(4):
        path = tmp_path / "one"
        path.write_bytes(random.Random(seed).randbytes(100))
        digests.append(store.put(path, "video/mp4"))
    found = [cache.get(store, digest) for digest in digests[:3]]
    assert all(path.exists() for path in found), "they are in use"
    now = time.time()
    for age, path in zip((3000, 4000, 2000), found, strict=True):
        os.utime(path, (now - age, now - age))
    assert cache.get(store, digests[0]) == found[0]
    cache.get(store, digests[3])
    assert [path.exists() for path in found] == [True, False, False]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"EVA_STORE": "relative"}, "allowed: the path of a folder that is there"),
        ({"EVA_STORE": "/no/such/folder"}, "allowed: the path of a folder that is there"),
        ({"EVA_STORE": "s3://"}, "allowed: s3://BUCKET"),
        ({"EVA_STORE": "s3://A_B"}, "allowed: s3://BUCKET"),
        ({"EVA_STORE": "s3://lab"}, "EVA_STORE_KEY and EVA_STORE_SECRET"),
        ({"EVA_STORE": "s3://lab", "EVA_STORE_ENDPOINT": "s3.example.org"}, "allowed: an origin"),
        ({"EVA_STORE": "s3://lab", "EVA_STORE_ENDPOINT": "https://a.b; script-src *"}, "allowed: an origin"),
        ({"EVA_STORE": "s3://lab", "EVA_STORE_ENDPOINT": "https://a.b/path"}, "allowed: an origin"),
    ],
)
def test_a_store_that_cannot_be_used_ends_the_start_with_a_sentence(monkeypatch, given, said):
    monkeypatch.setattr(environment, "find_spec", lambda name: object())
    if "EVA_STORE_ENDPOINT" in given:
        given = given | {"EVA_STORE_KEY": KEY, "EVA_STORE_SECRET": SECRET}
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ImproperlyConfigured, match=said):
        environment.store()


def test_a_bucket_without_its_package_is_a_sentence(monkeypatch):
    monkeypatch.setattr(environment, "find_spec", lambda name: None)
    monkeypatch.setenv("EVA_STORE", "s3://lab")
    with pytest.raises(ImproperlyConfigured, match=r"pip install -e '\.\[s3\]'"):
        environment.store()


@pytest.mark.exhaustive
def test_settings_are_read(monkeypatch, tmp_path):
    monkeypatch.setattr(environment, "find_spec", lambda name: object())
    assert environment.store() is None
    monkeypatch.setenv("EVA_STORE", str(tmp_path))
    assert environment.store() == tmp_path
    given = {"EVA_STORE": "s3://lab/eva/", "EVA_STORE_ENDPOINT": "http://10.0.0.1:9000/"}
    for name, value in {**given, "EVA_STORE_KEY": KEY, "EVA_STORE_SECRET": SECRET}.items():
        monkeypatch.setenv(name, value)
    bucket = environment.Bucket("lab", "eva", "http://10.0.0.1:9000", "us-east-1", KEY, SECRET)
    assert environment.store() == bucket
    assert SECRET not in str(bucket) + repr(bucket)
