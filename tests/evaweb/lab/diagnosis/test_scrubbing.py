import json

import pytest

from evaweb.blinding.visibility import HIDDEN
from evaweb.lab.diagnosis.scrubbing import REMOVED, Scrubber, known_secrets

SECRET = "Zq7-planted-9x"
LINES = (
    f"connecting to wss://user:{SECRET}@policy.example:443/ws",
    f"GET /infer?x=1&access_token={SECRET}&y=2 HTTP/1.1",
    f"Authorization: Bearer {SECRET}",
    f"authorization: Basic {SECRET}",
    f"'x-api-key': '{SECRET}'",
    f"password={SECRET}",
    f'  "client_secret": "{SECRET}",',
    f"OPENPI_KEY={SECRET}",
    f"EVA_POLICY_KEY = '{SECRET}'",
    f"ws://policy.example:9000/?key={SECRET}&x=1",
    f"EVA_POLICY_TOKEN = '{SECRET} with blanks'",
    f"Cookie: eva_session_ab12={SECRET}; other=1",
    f"login with bearer {SECRET} failed",
    f"the switch wants the password {SECRET}, not another one",
    f"the password is: {SECRET}",
    f"OPENPI_TOKEN {SECRET}",
    f"passphrase '{SECRET} with blanks' is wrong",
    f"started with --hub-token {SECRET} --private",
    f"-----BEGIN OPENSSH PRIVATE KEY-----\n{SECRET}\n-----END OPENSSH PRIVATE KEY-----",
    f"-----BEGIN RSA PRIVATE KEY-----\n{SECRET}\ncut off",
)


@pytest.mark.parametrize("line", LINES)
def test_what_looks_like_a_secret_goes_and_what_stands_around_it_stays(line):
    told = Scrubber(()).text(f"before it\n{line}\nafter it" if "cut off" not in line else line)
    assert SECRET not in told
    assert REMOVED in told
    assert "cut off" in line or (told.startswith("before it\n") and told.endswith("\nafter it"))


@pytest.mark.parametrize(
    "token",
    [
        "hf_abcdefghijklmnopqrst",
        "ghp_0123456789abcdefghijABCD",
        "sk-proj-0123456789abcdefghij",
        "AKIAABCDEFGHIJKLMNOP",
        "eva_" + "x" * 43,
        "eyJhbGciOiJIUzI1.eyJzdWIiOiIxMjM0.c2lnbmF0dXJl",
    ],
)
def test_tokens_of_known_makers_go_wherever_they_stand(token):
    assert (
        Scrubber(()).text(f"push to the hub with {token} failed") == f"push to the hub with {REMOVED} failed"
    )


def test_what_this_machine_knows_as_a_secret_goes_without_looking_like_one():
    assert Scrubber([SECRET]).text(f"the switch said {SECRET}!") == f"the switch said {REMOVED}!"


def test_sentences_of_a_lab_stay_as_they_are():
    said = (
        "2026-01-01 bench-1: running -> holding: no joints for 0.51 s (tcp://127.0.0.1:5555), 3 keys, x = 0.5"
    )
    assert Scrubber([SECRET]).text(said) == said


@pytest.mark.parametrize(
    "line", ["password 12345678", "pin 1234", "--password correcthorse", "password 'horse'"]
)
def test_no_sign_has_to_stand_before_a_secret(line):
    assert Scrubber(()).text(f"{line} was refused") == f"{line.split()[0]} {REMOVED} was refused"


def test_sentences_about_secrets_stay():
    said = (
        "the password of 'ann' is changed\ntoken 'nightly-export' of 'ann' is made, until 2027-02-20\n"
        "the secret is out: asks for a token again\nstarted with --api-key-env OPENPI_KEY"
    )
    assert Scrubber(()).text(said) == said


def test_names_of_variables_and_places_of_a_policy_stay():
    said = 'api_key_env = "EVA_POLICY_KEY"\npassword_env=CAMERA\nprompt_key = "prompt"\n{"token_env": "A_B"}'
    assert Scrubber(()).text(said) == said
    assert SECRET not in Scrubber(()).text(f'api_key_env = "{SECRET}"')


def test_numbers_are_secrets_where_a_password_or_pin_is_meant():
    told = Scrubber(()).tree({"password": 12345678, "door_pin": 1234, "pass": 1, "passed": 3, "pin": None})
    assert told == {"password": REMOVED, "door_pin": REMOVED, "pass": REMOVED, "passed": 3, "pin": None}


def test_a_table_loses_what_stands_under_the_name_of_a_secret_and_keeps_its_shape():
    table = {
        "policy": {"url": f"ws://u:{SECRET}@h:1", "token": SECRET, "headers": {"X-Api-Key": [SECRET]}},
        "cameras": [{"user": "eve", "password_env": "EVA_CAMERA", "rate": 3.5}],
        "tokens": 3,
    }
    told = Scrubber(()).tree(table)
    assert SECRET not in json.dumps(told)
    assert told["policy"]["url"] == f"ws://{REMOVED}@h:1"
    assert told["cameras"] == [{"user": "eve", "password_env": "EVA_CAMERA", "rate": 3.5}]
    assert told["tokens"] == 3


def test_names_that_are_hidden_from_the_reader_go_also_within_names_of_files():
    told = Scrubber((), ["alder"]).text("policy-alder.log of alder, not of alders")
    assert told == f"policy-{HIDDEN}.log of {HIDDEN}, not of alders"


def test_the_lab_knows_its_own_secrets(settings, tmp_path, monkeypatch):
    settings.DATA_DIR = tmp_path
    (tmp_path / "stations" / "bench-1").mkdir(parents=True)
    (tmp_path / "stations" / "bench-1" / "bus.key").write_text("key-of-the-bus")
    monkeypatch.setenv("DATABASE_URL", "postgres://eva:p%40ss-word@db/eva")
    monkeypatch.setenv("EVA_JUDGE_KEY", "key-of-the-judge")
    for name in ("EVA_POLICY_KEY", "OPENPI_KEY", "EVA_POLICY_LOGIN"):
        monkeypatch.setenv(name, f"value-of-{name}")
        assert f"value-of-{name}" in known_secrets()
    assert {"key-of-the-bus", "p@ss-word", "key-of-the-judge", settings.SECRET_KEY} <= known_secrets()
