"""Who is believed to have given a command, and who is not."""

from __future__ import annotations

import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest

from runtime.core.errors import ConfigurationError
from runtime.ipc.endpoints import account_name
from runtime.ipc.identity import Key, authenticate, display_name, missing_role, unverified_reason
from runtime.ipc.messages import Command, decode, encode

OWN = os.geteuid()
RUN = Command("u", "run", {"duration_s": 5.0}, "ann", "web:ann:p1", 3, "boot", 7, 12.5, "operator")


@pytest.fixture
def key(tmp_path: Path) -> Key:
    return Key(tmp_path)


def as_known(command: Command, key: Key, signature: bytes = b"", uid: int | None = OWN) -> Command:
    return authenticate(command, encode(command), signature, uid, key)


# --- the key -------------------------------------------------------------------------------------------------


def test_the_key_is_made_once_and_is_for_this_account_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        secret = Key(tmp_path / "bench").secret()
    finally:
        os.umask(before)
    path = tmp_path / "bench" / "bus.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert (len(secret), Key(tmp_path / "bench").secret()) == (32, secret)
    assert [found.name for found in path.parent.iterdir()] == ["bus.key"]


def test_of_two_that_make_it_at_once_both_have_the_same(key: Key, monkeypatch: pytest.MonkeyPatch) -> None:
    link = os.link
    theirs: list[bytes] = []

    def late(source: Path, target: Path) -> None:
        monkeypatch.setattr(os, "link", link)
        theirs.append(Key(key.path.parent).secret())
        link(source, target)

    monkeypatch.setattr(os, "link", late)
    assert key.secret() == theirs[0]
    assert list(key.path.parent.iterdir()) == [key.path]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_key_that_others_can_read_is_none(key: Key, mode: int) -> None:
    signature = key.sign(b"x")
    os.utime(key.path, (1, 1))
    key.path.chmod(mode)
    with pytest.raises(ConfigurationError, match=rf"{key.path} has the mode {mode:04o}.*allowed: .*0600"):
        key.secret()
    assert not key.verifies(b"x", signature)


def test_a_key_of_another_account_is_none(key: Key, monkeypatch: pytest.MonkeyPatch) -> None:
    key.secret()
    os.chown(key.path, 4711, -1) if OWN == 0 else monkeypatch.setattr(os, "geteuid", lambda: 4711)
    with pytest.raises(ConfigurationError, match="belongs to"):
        Key(key.path.parent).secret()


@pytest.mark.parametrize("content", [b"", b"x" * 31, b"x" * 33])
def test_a_key_of_another_length_is_none(key: Key, content: bytes) -> None:
    key.secret()
    key.path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=rf"has {len(content)} bytes; allowed: 32"):
        key.secret()


def test_a_key_that_was_replaced_is_taken(key: Key) -> None:
    before = key.sign(b"x")
    key.path.unlink()
    assert Key(key.path.parent).sign(b"x") != before
    assert key.verifies(b"x", Key(key.path.parent).sign(b"x"))
    assert not key.verifies(b"x", before)


# --- who it was ----------------------------------------------------------------------------------------------


def test_what_the_web_signs_is_believed(key: Key) -> None:
    known = as_known(RUN, key, key.sign(encode(RUN)))
    assert known == RUN
    assert (unverified_reason(known), missing_role(known), display_name(known)) == ("", "", "ann (operator)")


CHANGES = {
    "uuid": "v",
    "kind": "release",
    "args": {"duration_s": 6.0},
    "user": "root",
    "holder": "web:root:p1",
    "epoch": 4,
    "boot": "later",
    "sequence": 8,
    "valid_until": 99.0,
    "role": "admin",
    "vouched": ["policy"],
}


@pytest.mark.parametrize("field", CHANGES)
def test_a_signature_is_for_this_command_and_no_other(key: Key, field: str) -> None:
    signature = key.sign(encode(RUN))
    known = as_known(replace(RUN, **{field: CHANGES[field]}), key, signature)
    assert known.role == "unverified"
    assert known.user.endswith(" (unverified)")
    assert "not signed by this lab's web" in unverified_reason(known)


@pytest.mark.parametrize("signature", [b"\0", bytes(32), b"x" * 1000])
def test_a_made_up_signature_is_none(key: Key, signature: bytes) -> None:
    assert as_known(RUN, key, signature).role == "unverified"


def test_a_signature_of_another_stations_key_is_none(key: Key, tmp_path: Path) -> None:
    assert as_known(RUN, key, Key(tmp_path / "other").sign(encode(RUN))).role == "unverified"


def test_every_field_of_a_command_is_signed() -> None:
    assert set(CHANGES) == set(Command.__dataclass_fields__)
    assert decode(encode(RUN)) == RUN


def test_a_program_is_the_account_that_connects_whatever_it_says(key: Key) -> None:
    said = Command("u", "run", user="root", holder="terminal:root@moon", role="admin")
    known = as_known(said, key)
    assert (known.user, known.role) == (f"account:{account_name(OWN)}", "local")
    assert (unverified_reason(known), missing_role(known)) == ("", "")
    assert display_name(known) == f"account:{account_name(OWN)}"


@pytest.mark.parametrize("uid", [None, 4711])
def test_who_is_not_known_or_another_account_is_not_obeyed(key: Key, uid: int | None) -> None:
    known = as_known(Command("u", "run", user="ann", holder="terminal:ann@bench"), key, uid=uid)
    assert (known.user, known.role) == ("ann (unverified)", "unverified")
    assert unverified_reason(known)
    assert unverified_reason(as_known(Command("u", "run", holder="channel:lab#1"), key, uid=uid)), (
        "nor as a script"
    )


def test_without_a_signature_nobody_is_a_page(key: Key) -> None:
    known = as_known(RUN, key)
    assert (known.user, bool(unverified_reason(known))) == ("ann (unverified)", True)


def test_a_script_is_obeyed_and_never_called_verified(key: Key) -> None:
    known = as_known(Command("u", "run", holder="channel:lab#1"), key)
    assert (known.user, known.role, unverified_reason(known)) == ("channel:lab#1 (unverified)", "script", "")


@pytest.mark.parametrize(("role", "may"), [("viewer", False), ("", False), ("guest", False), ("admin", True)])
def test_a_role_is_asked_for_what_changes_something(key: Key, role: str, may: bool) -> None:
    said = replace(RUN, role=role)
    known = as_known(said, key, key.sign(encode(said)))
    assert (missing_role(known) == "") is may
    assert missing_role(replace(known, kind="lease_claim")) == missing_role(known).replace(
        "run", "lease_claim", 1
    )
    assert all(missing_role(replace(known, kind=kind)) == "" for kind in ("status", "lease_renew", "aim"))
