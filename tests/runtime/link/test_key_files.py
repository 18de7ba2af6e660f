"""Keys as files, and the code with which a computer is enrolled."""

import json
import stat
import threading
from dataclasses import asdict

import pytest
import zmq

from runtime import keys
from runtime.core.errors import ConfigurationError
from runtime.link import codes, key_files
from runtime.link.key_files import KnownLab

LAB = KnownLab("bench-7", "the lab", "lab.example.org", 8470, 8471, "00" * 32, "11" * 32)


def test_a_key_is_its_accounts_alone(tmp_path):
    made = key_files.make_station_key(tmp_path)
    path = key_files.key_path(tmp_path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert key_files.station_key(tmp_path) == made
    assert zmq.curve_public(key_files.z85(made.secret)) == key_files.z85(made.public)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_key_that_others_can_read_is_none(tmp_path, mode):
    key_files.make_station_key(tmp_path)
    key_files.key_path(tmp_path).chmod(mode)
    with pytest.raises(ConfigurationError, match="a reader can act as its owner"):
        key_files.station_key(tmp_path)


def test_a_key_that_is_cut_short_is_none(tmp_path):
    key_files.make_station_key(tmp_path)
    key_files.key_path(tmp_path).write_bytes(b"short")
    with pytest.raises(ConfigurationError, match="has 5 bytes; allowed: 32"):
        key_files.station_key(tmp_path)


def test_a_key_is_replaced_only_where_that_is_said(tmp_path):
    first = key_files.make_station_key(tmp_path)
    with pytest.raises(ConfigurationError, match="is there already"):
        key_files.make_station_key(tmp_path)
    assert key_files.station_key(tmp_path) == first
    assert key_files.make_station_key(tmp_path, replace=True) != first


def test_a_labs_keys_are_made_once_whoever_asks_first(tmp_path):
    found = []
    threads = [
        threading.Thread(
            target=lambda: found.append((key_files.lab_key(tmp_path), key_files.tokens_key(tmp_path)))
        )
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert set(found) == {found[0]}
    assert sorted(path.name for path in (tmp_path / "link").iterdir()) == ["lab.key", "tokens.key"]


def test_what_a_station_knows_of_its_lab_comes_back(tmp_path):
    key_files.save_lab(tmp_path, LAB)
    assert key_files.known_lab(tmp_path) == LAB


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        "[" * 5000,
        json.dumps({"station": "bench-7"}),
        json.dumps({**asdict(LAB), "key": "00"}),
    ],
)
def test_a_file_about_the_lab_that_is_of_no_use_is_named(tmp_path, content):
    key_files.known_lab_path(tmp_path).write_text(content)
    with pytest.raises(ConfigurationError, match="enrol the station again"):
        key_files.known_lab(tmp_path)


def test_a_station_that_is_not_enrolled_is_told_how(tmp_path):
    with pytest.raises(ConfigurationError, match=r"python -m runtime\.keys enrol ADDRESS CODE"):
        key_files.known_lab(tmp_path / "bench-7")


# --- the code ---------------------------------------------------------------------------------------------------------


def test_a_code_is_read_as_it_is_shown_however_it_was_copied():
    code = codes.fresh(bytes(range(32)))
    shown = code.text()
    assert len(shown.split("-")) == 9
    for copied in (shown, shown.lower(), shown.replace("-", " "), f"  {shown}\n", shown.replace("-", "")):
        assert codes.read(copied) == code


@pytest.mark.parametrize("at", range(0, 72, 5))
def test_a_letter_that_is_mistyped_is_noticed_before_anything_is_asked(at):
    letters = codes.fresh(bytes(range(32))).text().replace("-", "")
    other = "A" if letters[at] != "A" else "B"
    with pytest.raises(ConfigurationError, match="mistyped"):
        codes.read(letters[:at] + other + letters[at + 1 :])


@pytest.mark.parametrize("given", ["", "ABC", "!" * 72, "A" * 71, "A" * 72, "é" * 72])
def test_what_is_no_code_is_refused(given):
    with pytest.raises(ConfigurationError, match="not whole, or mistyped"):
        codes.read(given)


def test_of_a_code_the_lab_keeps_a_digest_alone():
    one, other = codes.fresh(bytes(32)), codes.fresh(bytes(32))
    assert codes.digest(one.secret) != codes.digest(other.secret)
    assert one.secret.hex() not in codes.digest(one.secret)


# --- the command line -------------------------------------------------------------------------------------------------


def test_new_and_show_say_fingerprints_and_never_a_secret(tmp_path, capsys):
    assert keys.main(["--data-dir", str(tmp_path), "new"]) == 0
    key = key_files.station_key(tmp_path)
    key_files.save_lab(tmp_path / "stations" / "bench-7", LAB)
    assert keys.main(["--data-dir", str(tmp_path), "show"]) == 0
    said = capsys.readouterr().out
    assert said.count(codes.fingerprint(key.public)) == 2
    assert "bench-7: the lab at lab.example.org, ports 8470 and 8471" in said
    assert key.secret.hex() not in said


def test_a_second_key_is_refused_with_a_sentence(tmp_path, capsys):
    assert keys.main(["--data-dir", str(tmp_path), "new"]) == 0
    assert keys.main(["--data-dir", str(tmp_path), "new"]) == 1
    assert "is there already" in capsys.readouterr().err
    assert keys.main(["--data-dir", str(tmp_path), "new", "--replace"]) == 0


@pytest.mark.parametrize("address", ["lab", "lab:", ":8470", "lab:0", "lab:70000", "lab:x"])
def test_an_address_that_is_none_is_refused_before_anything_is_asked(tmp_path, capsys, address):
    keys.main(["--data-dir", str(tmp_path), "new"])
    code = codes.fresh(bytes(range(32))).text()
    assert keys.main(["--data-dir", str(tmp_path), "enrol", address, code]) == 1
    assert "allowed: HOST:PORT" in capsys.readouterr().err
