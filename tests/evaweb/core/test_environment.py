import re
import sqlite3
import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from django.core.exceptions import ImproperlyConfigured

from evaweb.core import environment, file_checks
from tests.processes import PATIENCE_S

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(("given", "found"), [("1", True), (" Yes ", True), ("off", False), ("", False)])
def test_a_flag_is_a_word(monkeypatch, given, found):
    monkeypatch.setenv("EVA_X", given)
    assert environment.read_flag("EVA_X", not found) is found


@pytest.mark.parametrize(
    ("read", "given", "allowed"),
    [
        (lambda: environment.read_flag("EVA_X", False), "maybe", "1, true, yes, on, 0, false, no, off"),
        (lambda: environment.read_seconds("EVA_X", 1.0), "0", "seconds above zero"),
        (lambda: environment.read_seconds("EVA_X", 1.0), "nan", "seconds above zero"),
        (lambda: environment.read_seconds("EVA_X", 1.0), "2 s", "seconds above zero"),
        (lambda: environment.niceness("EVA_X", 19), "20", "allowed: 0 to 19"),
        (lambda: environment.niceness("EVA_X", 19), "-1", "allowed: 0 to 19"),
        (lambda: environment.read_networks("EVA_X"), "10.0.0.1/24", "10.0.0.0/24"),
        (lambda: environment.read_networks("EVA_X"), "proxy", "127.0.0.1"),
        (lambda: environment.log_level("EVA_X", "INFO"), "LOUD", "DEBUG, INFO, WARNING, ERROR, CRITICAL"),
        (lambda: environment.time_zone("EVA_X", "UTC"), "Mars", "UTC, Europe/Berlin"),
        (lambda: environment.time_zone("EVA_X", "UTC"), "Europe", "UTC, Europe/Berlin"),
        (lambda: environment.time_zone("EVA_X", "UTC"), "../passwd", "UTC, Europe/Berlin"),
    ],
)
def test_what_cannot_be_used_is_named_with_what_is_allowed(monkeypatch, read, given, allowed):
    monkeypatch.setenv("EVA_X", given)
    with pytest.raises(ImproperlyConfigured) as refused:
        read()
    assert f"EVA_X = {given!r}" in str(refused.value)
    assert allowed in str(refused.value)


def test_what_is_not_given_is_the_default(monkeypatch):
    monkeypatch.delenv("EVA_X", raising=False)
    assert environment.read_flag("EVA_X", True) is True
    assert environment.read_seconds("EVA_X", 2.5) == 2.5
    assert environment.niceness("EVA_X", 19) == 19
    assert environment.read_list("EVA_X", ("a", "b")) == ["a", "b"]
    assert environment.log_level("EVA_X", "INFO") == "INFO"
    assert environment.time_zone("EVA_X", "Asia/Shanghai") == "Asia/Shanghai"


def test_a_list_has_commas_and_no_blanks(monkeypatch):
    monkeypatch.setenv("EVA_X", " lab.example.org, 10.0.0.7 ,")
    assert environment.read_list("EVA_X") == ["lab.example.org", "10.0.0.7"]


def test_an_absent_driver_is_named_with_how_to_get_it(monkeypatch):
    monkeypatch.setattr(environment, "find_spec", lambda name: None)
    environment.require_driver("DATABASE_URL", "django.db.backends.sqlite3")
    with pytest.raises(ImproperlyConfigured, match=r"DATABASE_URL names PostgreSQL.*\[lab\]"):
        environment.require_driver("DATABASE_URL", "django.db.backends.postgresql")


def test_the_key_is_made_once_and_is_its_users_alone(monkeypatch, tmp_path):
    monkeypatch.delenv("EVA_SECRET_KEY", raising=False)
    made = environment.secret_key(tmp_path)
    assert len(made) > 50
    assert environment.secret_key(tmp_path) == made
    assert stat.S_IMODE((tmp_path / "secret_key").stat().st_mode) == 0o600
    monkeypatch.setenv("EVA_SECRET_KEY", "given")
    assert environment.secret_key(tmp_path) == "given"


def test_the_id_of_a_lab_is_made_once_and_names_cookies(tmp_path):
    made = environment.lab_id(tmp_path)
    assert re.fullmatch("[0-9a-f]{8}", made)
    assert environment.lab_id(tmp_path) == made
    (tmp_path / "lab_id").write_text("Bench3\n")
    assert environment.lab_id(tmp_path) == "Bench3"


@pytest.mark.parametrize("given", ["", "a b", "a;b", "é", "x" * 33])
def test_an_id_that_names_no_cookie_is_refused(tmp_path, given):
    (tmp_path / "lab_id").write_text(given, "utf-8")
    with pytest.raises(ImproperlyConfigured, match=r"lab_id.*remove it, and everybody logs in anew"):
        environment.lab_id(tmp_path)


def test_a_private_file_is_made_for_its_user_alone_and_left_as_it_is_where_it_is(tmp_path):
    path = environment.private_file(tmp_path / "eva.sqlite3")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    database = sqlite3.connect(path)
    database.executescript(
        "PRAGMA journal_mode=WAL; CREATE TABLE session (key); INSERT INTO session VALUES (1);"
    )
    assert {stat.S_IMODE(file.stat().st_mode) for file in tmp_path.iterdir()} == {0o600}
    environment.private_file(path)
    assert database.execute("SELECT key FROM session").fetchall() == [(1,)]
    database.close()


def test_what_was_copied_back_readable_by_all_is_its_users_alone_again(monkeypatch, tmp_path):
    monkeypatch.delenv("EVA_SECRET_KEY", raising=False)
    for name in ("eva.sqlite3", "eva.sqlite3-wal", "eva.sqlite3-shm", "secret_key", "other"):
        (tmp_path / name).write_text("x")
        (tmp_path / name).chmod(0o644)
    environment.private_file(tmp_path / "eva.sqlite3")
    environment.secret_key(tmp_path)
    open_to_all = [file.name for file in tmp_path.iterdir() if environment.readable_by_others(file)]
    assert open_to_all == ["other"]


def test_a_new_data_folder_is_its_users_alone_and_one_that_is_there_stays_as_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("EVA_DATA_DIR", str(tmp_path / "a" / "data"))
    assert stat.S_IMODE(environment.data_dir(tmp_path).stat().st_mode) == 0o700
    (tmp_path / "a" / "data").chmod(0o750)
    assert stat.S_IMODE(environment.data_dir(tmp_path).stat().st_mode) == 0o750


def test_what_others_can_read_is_named_at_the_start_with_what_to_do(monkeypatch, tmp_path):
    database = {"ENGINE": "django.db.backends.sqlite3", "NAME": tmp_path / "eva.sqlite3"}
    monkeypatch.setattr(
        file_checks, "settings", SimpleNamespace(DATA_DIR=tmp_path, DATABASES={"default": database})
    )
    wrong = {tmp_path: 0o755, tmp_path / "eva.sqlite3": 0o644, tmp_path / "eva.sqlite3-wal": 0o640}
    for path in list(wrong)[1:]:
        path.touch()
    for path, mode in wrong.items():
        path.chmod(mode)
    told = file_checks.check_private_files()
    assert [one.msg for one in told] == [
        f"{path} can be read by others: {mode:o}" for path, mode in wrong.items()
    ]
    assert [one.hint for one in told] == [
        f"chmod {mode} {path}" for path, mode in zip(wrong, (700, 600, 600), strict=True)
    ]
    for path, mode in zip(wrong, (0o700, 0o600, 0o600), strict=True):
        path.chmod(mode)
    assert file_checks.check_private_files() == []


def test_a_proxy_that_nobody_has_declared_is_asked_for(settings):
    assert file_checks.check_declared_proxy() == []
    settings.SESSION_COOKIE_SECURE = True
    assert "EVA_PROXIES is not given" in file_checks.check_declared_proxy()[0].msg
    settings.EVA_PROXIES = ["127.0.0.1"]
    assert file_checks.check_declared_proxy() == []


def test_networks_are_addresses_too(monkeypatch):
    monkeypatch.setenv("EVA_X", "127.0.0.1, 10.0.0.0/24,::1")
    assert [str(one) for one in environment.read_networks("EVA_X")] == [
        "127.0.0.1/32",
        "10.0.0.0/24",
        "::1/128",
    ]


def test_a_wrong_setting_ends_the_start_with_one_sentence(tmp_path):
    environ = {"EVA_DATA_DIR": str(tmp_path), "EVA_LOG_LEVEL": "LOUD"}
    command = [sys.executable, str(ROOT / "manage.py"), "check"]
    ended = subprocess.run(
        command, env=environ, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert ended.returncode == 1
    assert ended.stderr.startswith("cannot start: EVA_LOG_LEVEL = 'LOUD'; allowed:")
    assert "Traceback" not in ended.stderr


def test_the_web_runs_from_a_checkout():
    assert environment.checkout(ROOT) == ROOT


def test_without_its_pages_the_web_does_not_start_and_says_how_it_would(tmp_path):
    (tmp_path / "static").mkdir()
    with pytest.raises(ImproperlyConfigured, match="has no templates: the web runs from a checkout"):
        environment.checkout(tmp_path)
    (tmp_path / "static").rmdir()
    with pytest.raises(
        ImproperlyConfigured, match=r"has no templates and no static: .*pip install --editable"
    ):
        environment.checkout(tmp_path)
