"""The chat judge against a server on loopback: what it sends, and what of all that can come back is a verdict."""

import base64
import json
import re
import socket
import ssl
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from evaweb.core.errors import EvaError
from evaweb.results.judges.base import (
    CaseJudgement,
    MilestoneJudgement,
    MilestonePrompt,
    NoVerdict,
    Setup,
    StillImage,
    TrialCase,
)
from evaweb.results.judges.chat import LARGEST_ANSWER, build, endpoint_of
from tests.evaweb.plans.lab import jpeg
from tests.evaweb.results.judges.server import http, message, said, serving

CASE = TrialCase(
    "put the block on the plate",
    "the block rests on the plate",
    (MilestonePrompt("held"), MilestonePrompt("on the plate", 20.0)),
    (
        StillImage("camera 1", 0.0, jpeg(1)),
        StillImage("camera 1", 7.5, jpeg(2)),
        StillImage("camera 2", 0.0, jpeg(3)),
    ),
)
GOOD = said((2, "not reached", 0.25), (1, "reached", 1))
KEY = "sk-canary-71"


def asked(play, **setup):
    """What a judge says after a server did so, and the requests that it heard."""
    with serving(play) as server:
        judge = build(Setup(**{"address": server.address, "model": "seer", "patience_s": 20.0, **setup}))
        try:
            return judge.judge(CASE), server.heard
        except NoVerdict as none:
            return str(none), server.heard


def test_a_verdict_of_each_milestone_comes_back_with_the_model_that_answered():
    verdict, _ = asked(GOOD)
    assert verdict == CaseJudgement(
        (MilestoneJudgement(True, 1.0), MilestoneJudgement(False, 0.25)), "seer-2026-11-01"
    )


def test_no_verdict_on_one_milestone_is_none_and_the_others_stand():
    verdict, _ = asked(said((1, "no verdict", None), (2, "reached", 0.9)))
    assert verdict.milestones == (MilestoneJudgement(), MilestoneJudgement(True, 0.9))


def test_what_is_sent_is_the_question_and_the_pictures(monkeypatch):
    monkeypatch.setenv("EVA_JUDGE_KEY", f"{KEY}\n")
    _, heard = asked(GOOD, key_variable="EVA_JUDGE_KEY")
    ((head, body),) = heard
    assert head.startswith("POST /v1/chat/completions HTTP/1.1\r\n")
    assert f"Authorization: Bearer {KEY}\r\n" in head
    sent = json.loads(body)
    assert set(sent) == {"model", "temperature", "response_format", "messages"}
    system, user = sent["messages"]
    assert build(Setup("https://h.example", "seer")).prompt_text(CASE) == json.dumps(
        [system["content"], user["content"][0]["text"]], ensure_ascii=False
    )
    assert user["content"][0]["text"] == (
        "The robot was told: put the block on the plate\nSuccess: the block rests on the plate\nMilestones:\n"
        "1. held\n2. on the plate (within 20 s)"
    )
    captions = [part["text"] for part in user["content"][1:] if part["type"] == "text"]
    assert captions == ["camera 1, 0.0 s", "camera 1, 7.5 s", "camera 2, 0.0 s"]
    urls = [part["image_url"]["url"] for part in user["content"] if part["type"] == "image_url"]
    assert [base64.b64decode(url.removeprefix("data:image/jpeg;base64,")) for url in urls] == [
        still.jpeg for still in CASE.stills
    ]


def test_a_judge_without_a_key_sends_none():
    _, ((head, _),) = asked(GOOD)
    assert "authorization" not in head.lower()


@pytest.mark.parametrize(
    ("play", "reason"),
    [
        (message(None, refusal="I do not judge robots."), "it refused: I do not judge robots."),
        (message("", "content_filter"), "it refused: its filter"),
        (message('{"milestones": [', "length"), "the answer is incomplete: finish_reason = 'length'"),
        (message("The block was held."), "the answer is not in the requested form: Invalid JSON"),
        (message('```json\n{"milestones": []}\n```'), "not in the requested form: Invalid JSON"),
        (message(None), "not in the requested form"),
        (message("[]"), "not in the requested form"),
        (message('{"milestones": [], "score": 1}'), "not in the requested form: score"),
        (said((1, "reached", 0.9)), r"it spoke of the milestones \[1\]; asked were 1 to 2"),
        (said((1, "reached", 0.9), (2, "reached", 0.9), (3, "reached", 0.9)), "asked were 1 to 2"),
        (said((1, "reached", 0.9), (1, "reached", 0.9)), r"\[1, 1\]"),
        (
            said((1, "reached", 1.5), (2, "reached", 0.9)),
            "milestones.0.probability: .*less than or equal to 1",
        ),
        (said((1, "reached", -0.1), (2, "reached", 0.9)), "probability"),
        (said((1, "reached", float("nan")), (2, "reached", 0.9)), "probability"),
        (said((1, "reached", float("inf")), (2, "reached", 0.9)), "probability"),
        (said((1, "reached", "0.9"), (2, "reached", 0.9)), "probability"),
        (said((1, "reached", True), (2, "reached", 0.9)), "probability"),
        (
            said((1, "reached", None), (2, "reached", 0.9)),
            "milestone 1: a verdict and its probability stand together",
        ),
        (said((1, "no verdict", 0.5), (2, "reached", 0.9)), "stand together"),
        (said((1, "reached", 0.2), (2, "reached", 0.9)), "milestone 1: 0.2 .* contradicts"),
        (said((1, "maybe", 0.5), (2, "reached", 0.9)), "milestones.0.verdict"),
        (said(("1", "reached", 0.9), (2, "reached", 0.9)), "milestones.0.number"),
        (http(body=b"[" * 100_000), "the answer is not a completion"),
        (http(body=b'{"choices": []}'), "the answer is not a completion: choices"),
        (http(body=b"\xff\xfe"), "the answer is not a completion"),
        (http(500, b"boom"), "the server answered HTTP 500"),
        (http(429, b"", "Retry-After: 1"), "the server answered HTTP 429"),
        (lambda connection: connection.wfile.write(b"SSH-2.0-odd\r\n"), "does not speak HTTP as is usual"),
        (lambda connection: None, "does not speak HTTP|cannot be reached"),
        (http(body=b"x" * (LARGEST_ANSWER + 1)), f"longer than {LARGEST_ANSWER} bytes"),
    ],
)
def test_whatever_else_comes_back_is_no_verdict_and_is_asked_once(play, reason):
    told, heard = asked(play)
    assert isinstance(told, str)
    assert re.search(reason, told), told
    assert len(heard) == 1


def test_an_answer_without_end_is_left_when_it_is_too_long():
    def endless(connection):
        connection.wfile.write(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n")
        while True:  # until the client hangs up
            connection.wfile.write(b"10000\r\n" + b" " * 65536 + b"\r\n")

    assert asked(endless)[0] == f"the answer is longer than {LARGEST_ANSWER} bytes"


def test_a_server_that_says_nothing_is_left():
    with serving(lambda connection: server.over.wait()) as server:
        judge = build(Setup(server.address, "seer", patience_s=0.3))
        with pytest.raises(NoVerdict, match=r"no answer within 0\.3 s"):
            judge.judge(CASE)


@pytest.mark.parametrize("head", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\n\r\n"])
def test_a_server_that_says_a_little_for_ever_is_left_when_the_time_is_over(head):
    def drip(connection):
        connection.wfile.write(head)
        while not server.over.wait(0.02):
            connection.wfile.write(b"x")

    with serving(drip) as server:
        judge = build(Setup(server.address, "seer", patience_s=0.5))
        with pytest.raises(NoVerdict, match=r"no answer within 0\.5 s"):
            judge.judge(CASE)


def test_it_is_not_led_elsewhere():
    with serving(GOOD) as other:
        for status in (301, 302, 307, 308):
            told, heard = asked(http(status, b"", f"Location: {other.address}/chat/completions"))
            assert told == f"the server sends on to elsewhere (HTTP {status}), which is not followed"
            assert len(heard) == 1
        assert other.heard == []


def test_no_proxy_of_the_environment_is_used(monkeypatch):
    with serving(GOOD) as proxy:
        for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY"):
            monkeypatch.setenv(name, proxy.address)
        verdict, heard = asked(GOOD)
        assert (len(verdict.milestones), len(heard), proxy.heard) == (2, 1, [])


def test_a_server_that_is_not_there_is_no_verdict():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        with pytest.raises(NoVerdict, match="the server cannot be reached: Connection refused"):
            build(Setup(f"http://127.0.0.1:{taken.getsockname()[1]}", "seer")).judge(CASE)


def test_a_server_whose_certificate_nobody_vouches_for_is_sent_nothing(tmp_path):
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(_self_signed(tmp_path / "server.pem"))
    with serving(GOOD, tls) as server:
        judge = build(Setup(server.address.replace("http", "https", 1), "seer", patience_s=20.0))
        with pytest.raises(NoVerdict, match="the server's certificate does not hold: self-signed"):
            judge.judge(CASE)
        assert server.heard == []


def _self_signed(path):
    key, name = (
        ec.generate_private_key(ec.SECP256R1()),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "x")]),
    )
    now = datetime.now(UTC)
    made = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    made = made.serial_number(1).not_valid_before(now - timedelta(1)).not_valid_after(now + timedelta(1))
    address = x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))])
    certificate = made.add_extension(address, critical=False).sign(key, hashes.SHA256())
    plain = (Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    path.write_bytes(key.private_bytes(*plain) + certificate.public_bytes(Encoding.PEM))
    return path


def test_a_key_that_a_server_quotes_is_kept_nowhere(monkeypatch):
    monkeypatch.setenv("EVA_JUDGE_KEY", KEY)
    for play in (
        message(None, refusal=f"the key {KEY} is refused"),
        message(f'{{"milestones": [], "{KEY}": 1}}'),
        http(401, f"wrong key {KEY}".encode()),
        http(body=json.dumps({"model": KEY, "choices": []}).encode()),
    ):
        assert KEY not in asked(play, key_variable="EVA_JUDGE_KEY")[0]


@pytest.mark.parametrize("written", ["sk-abc\\/def+ghi", "sk-abc\\u002fdef\\u002bghi"])
def test_a_key_that_a_server_quotes_as_json_escapes_it_is_kept_nowhere(written, monkeypatch):
    monkeypatch.setenv("EVA_JUDGE_KEY", "sk-abc/def+ghi")
    line = '{"milestones": [{"number": %d, "verdict": "reached", "probability": 1}%s]}'
    verdicts = json.dumps(line % (1, ', {"number": 2, "verdict": "reached", "probability": 1}'))
    extra = json.dumps('{"milestones": [], "KEY": 1}').replace("KEY", written.replace("\\", "\\\\"))
    bodies = [
        f'{{"choices": [{{"message": {{"refusal": "bad key {written}"}}}}]}}',
        f'{{"choices": [{{"message": {{}}, "finish_reason": "after so many words as these are: {written}"}}]}}',
        f'{{"choices": [{{"message": {{"content": {extra}}}}}]}}',
        f'{{"model": "m of {written}", "choices": [{{"message": {{"content": {verdicts}}}}}]}}',
    ]
    for body in bodies:
        told, _ = asked(http(body=body.encode()), key_variable="EVA_JUDGE_KEY")
        assert "abc" not in str(told)
        assert "..." in str(told)


def test_a_model_that_is_called_as_its_key_is_not_asked(monkeypatch):
    monkeypatch.setenv("EVA_JUDGE_KEY", KEY)
    with pytest.raises(EvaError, match="name the model without its key") as fault:
        asked(GOOD, key_variable="EVA_JUDGE_KEY", model=f"seer?key={KEY}")
    assert KEY not in str(fault.value)


@pytest.mark.parametrize("value", [None, "", "two words", "sk-\nX-Other: 1", "ключ"])
def test_a_key_that_is_none_is_named_by_its_variable_and_nothing_is_sent(value, monkeypatch):
    monkeypatch.delenv("EVA_JUDGE_KEY", raising=False)
    if value is not None:
        monkeypatch.setenv("EVA_JUDGE_KEY", value)
    with serving(GOOD) as server:
        judge = build(Setup(server.address, "seer", "EVA_JUDGE_KEY"))
        with pytest.raises(EvaError, match="variable EVA_JUDGE_KEY") as fault:
            judge.judge(CASE)
        assert (server.heard, bool(value) and value in str(fault.value)) == ([], False)


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        ({"address": ""}, "allowed: https://HOST"),
        ({"address": "ftp://judge.example"}, "allowed: https://HOST"),
        ({"address": "https://"}, "allowed: https://HOST"),
        ({"address": "https://me:secret@judge.example"}, "allowed: https://HOST"),
        ({"address": "https://judge.example/v1?key=1"}, "allowed: https://HOST"),
        ({"address": "https://judge.example:99999"}, "allowed: https://HOST"),
        ({"address": "https://judge.example:0/"}, "port 0; allowed: 1 to 65535"),
        ({"address": "https://judge.example/a b"}, "allowed: https://HOST"),
        ({"address": "http://judge.example/v1"}, "for everybody to read"),
        ({"address": "http://10.0.0.7:8000"}, "for everybody to read"),
        ({"address": "http://127.0.0.1.example"}, "for everybody to read"),
        ({"model": " "}, "model is empty"),
        ({"key_variable": "DATABASE_URL"}, "EVA_JUDGE_"),
        ({"key_variable": "EVA_SECRET_KEY"}, "EVA_JUDGE_"),
    ],
)
def test_a_set_up_that_cannot_be_is_refused_in_a_sentence(setup, words):
    with pytest.raises(EvaError, match=words):
        build(Setup(**{"address": "https://judge.example/v1", "model": "seer", **setup}))


@pytest.mark.parametrize(
    ("address", "plain", "place"),
    [
        ("https://judge.example/v1/", False, (True, "judge.example", 443, "/v1/chat/completions")),
        ("http://localhost:8000", False, (False, "localhost", 8000, "/chat/completions")),
        ("http://[::1]:8000/v1", False, (False, "::1", 8000, "/v1/chat/completions")),
        ("http://10.0.0.7/v1", True, (False, "10.0.0.7", 80, "/v1/chat/completions")),
    ],
)
def test_an_address_is_asked_below_its_path(address, plain, place):
    found = endpoint_of(Setup(address, "seer", plain=plain))
    assert (found.secure, found.host, found.port, found.path) == place
