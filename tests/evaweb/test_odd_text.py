"""Whatever stands in an address, a question, a form or in JSON: it is answered, and never by a fault of ours."""

from __future__ import annotations

import json
import re
import uuid

import pytest
from django.http import QueryDict
from django.test import Client
from django.urls import NoReverseMatch, get_resolver, reverse

from evaweb.api.api import api
from evaweb.serving.headers import DEFAULT_HEADERS
from tests.evaweb.crawling import named

pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.slow]
ODD = {
    "nul": "%00",
    "long": "x" * 3000,
    "half": "%ED%A0%80",
    "no utf-8": "%80%FF",
    "line": "a%0Ab%0D",
    "dots": "..%2F..%2Fetc",
    "up": "..",
    "wide": "%F0%9F%A4%96" * 200,
    "number": "9" * 3000,
}
MARK, NUMBER = "placeholder", 987654321
KNOWN = {"digest": "0" * 64, "camera": MARK, "segment": str(uuid.UUID(int=1)), "uuid": str(uuid.UUID(int=1))}
QUESTIONS = (
    *(
        "name",
        "scene",
        "plan",
        "checkpoint",
        "station",
        "first",
        "second",
        "words",
        "quality",
        "review",
        "status",
    ),
    *(
        "since",
        "limit",
        "offset",
        "dataset",
        "robot",
        "groups",
        "replay",
        "space",
        "position",
        "operator",
        "key",
    ),
    *(
        "format",
        "episode",
        "row",
        "page",
        "after",
        "tag",
        "version",
        "rate",
        "t",
        "show",
        "state",
        "kind",
        "next",
    ),
)


def addresses():
    """Every named address with a place for odd text in it."""
    for name, parameters in sorted(named(get_resolver())):
        for values in (KNOWN, {**KNOWN, "version": 1, "index": 0}):
            kwargs = {one: values.get(one, MARK) for one in parameters}
            for number in ({}, {one: NUMBER for one in parameters if one in ("id", "index", "version")}):
                try:
                    yield reverse(name, kwargs=kwargs | number)
                except NoReverseMatch:
                    continue


PATHS = sorted(set(addresses()))


@pytest.fixture
def admin(alma, bench, live):
    client = Client(raise_request_exception=False, headers={"accept": "text/html"})
    client.force_login(alma)
    return client


def odd_addresses(odd):
    """Every address that has a place for it, with it there."""
    digits = {"number": "9" * 5000, "long": "9" * 30, "nul": str(NUMBER)}.get(odd, str(NUMBER))
    for path in PATHS:
        text = path.replace(MARK, ODD[odd]).replace(str(NUMBER), digits)
        if odd in ("line", "nul"):
            text = text.replace(str(uuid.UUID(int=1)), f"{uuid.UUID(int=1)}{ODD[odd]}")
        if (text != path or odd == "nul") and not path.endswith("/logout/"):
            yield text


HEADERS = {name.decode().title() for name, _ in DEFAULT_HEADERS}


def faults_of(answer):
    """What is wrong with an answer, whatever was asked."""
    status, kind = answer.status_code, answer.headers.get("Content-Type", "")
    rest = answer.wsgi_request.path.startswith("/api/")
    if status >= 500 and status != 503:
        yield status
    if status >= 400 and rest and not kind.startswith("application/json"):
        yield f"{status} as {kind}"
    if status >= 400 and not rest and b"css/tokens.css" not in answer.content:
        yield f"{status} of nobody's: {answer.content[:80]}"
    if missing := HEADERS - set(answer.headers):
        yield f"without {missing}"


@pytest.mark.some(1)
@pytest.mark.parametrize(
    "role",
    ["operator", *(pytest.param(role, marks=pytest.mark.exhaustive) for role in ("nobody", "vera", "alma"))],
)
@pytest.mark.parametrize(
    "odd", [pytest.param(odd, marks=[] if odd in ("nul", "half") else pytest.mark.exhaustive) for odd in ODD]
)
def test_in_addresses(request, bench, live, odd, role):
    client = Client(raise_request_exception=False, headers={"accept": "text/html"})
    if role != "nobody":
        client.force_login(bench.operator if role == "operator" else request.getfixturevalue(role))
    asked, faults = 0, set()
    for path in odd_addresses(odd):
        for method in ("get", "post") if role == "alma" else ("get",):
            asked += 1
            answer = getattr(client, method)(path)
            faults |= {f"{method} {path[:120]}: {fault}" for fault in faults_of(answer)}
    assert faults == set()
    assert asked > 10


WHOLE = ("__iter__", "items", "keys", "values", "dict", "copy", "urlencode")


@pytest.fixture
def looked(monkeypatch):
    """The parameters that pages look for in their questions, whether they are there or not."""
    found = set()

    def watched(name):
        real = getattr(QueryDict, name)

        def watch(question, *given, **named):
            found.update(QUESTIONS if name in WHOLE else [str(given[0])])
            return real(question, *given, **named)

        return watch

    for name in (*WHOLE, "__getitem__", "__contains__", "getlist"):
        monkeypatch.setattr(QueryDict, name, watched(name))
    return found


def asks(client, path, looked):
    """The parameters that are asked for there, alone and together.

    REST names its own. Pages take all, and one that a page does not look for changes nothing in what it does.
    """
    looked.clear()
    answer = client.get(f"{path}?nonsense=1", headers={"accept": "*/*"})
    if answer.status_code == 422 and b"unknown parameter; allowed: " in answer.content:
        known = answer.json()["error"].partition("allowed: ")[2].split(", ")
        return known, known
    if path.startswith("/api/") or answer.status_code == 405:
        return (), ()
    return sorted(looked), sorted(looked | set(QUESTIONS))


@pytest.mark.exhaustive
def test_in_questions(admin, looked):
    """Each parameter alone with the two texts that go farthest, and all of them together with the others."""
    faults, count = set(), 0
    for path in PATHS:
        if MARK in path or str(NUMBER) in path or path.endswith("/logout/"):
            continue
        single, known = asks(admin, path, looked)
        alone = [f"{one}={ODD[odd]}" for one in single for odd in ("long", "number")]
        together = ["&".join(f"{one}={odd}" for one in known) for odd in ODD.values() if known]
        count += len(alone)
        for asked in alone + together:
            answer = admin.get(f"{path}?{asked}")
            if answer.status_code >= 500:
                faults.add(f"{path}?{asked:.40}: {answer.status_code}")
    assert faults == set()
    assert count > 150


TEXTS = {
    "nul": "a\x00b",
    "half": "a\ud800",
    "long": "x" * 3000,
    "wide": "🤖" * 300,
    "dots": "../../etc",
    "line": "a\nb",
}
NUMBERS = (10**30, -1, 1e308)


def bodies(schema, known):
    """Bodies that fit, each with one odd thing in one place."""
    fields = known["components"]["schemas"][schema]["properties"]
    whole = {name: _fitting(field, known) for name, field in fields.items()}
    yield whole
    for name, value in whole.items():
        odd = TEXTS.values() if isinstance(value, str) else NUMBERS if type(value) in (int, float) else ()
        for one in (*odd, *([{"a": text} for text in TEXTS.values()] if isinstance(value, dict) else ())):
            yield {**whole, name: one}


def _fitting(field, known):
    if "$ref" in field:
        found = known["components"]["schemas"][field["$ref"].rpartition("/")[2]]
        return _fitting(found, known) if "properties" not in found else {}
    if "anyOf" in field:
        return _fitting(field["anyOf"][0], known)
    if "enum" in field or "const" in field:
        return field.get("const") or field["enum"][0]
    if field.get("format") == "uuid":
        return str(uuid.uuid4())
    empty = {"string": "x", "integer": 1, "number": 1.0, "boolean": True, "array": [], "object": {}}
    return empty[field.get("type", "object")]


def posts(known):
    for path, methods in sorted(known["paths"].items()):
        content = methods.get("post", {}).get("requestBody", {}).get("content", {}).get("application/json")
        reference = str((content or {}).get("schema", {}))
        for schema in sorted(known["components"]["schemas"]):
            if f"/{schema}'" in reference:
                yield path, schema


@pytest.mark.exhaustive
def test_in_json(admin, bench, live):
    known, faults, asked = api.get_openapi_schema(), set(), 0
    trial = bench.prepare()
    for path, schema in posts(known):
        for station in (bench.station.name, live.name):
            address = path.replace("{name}", station).replace("{id}", str(trial.pk))
            address = re.sub(r"{\w+}", str(uuid.UUID(int=1)), address)
            for body in bodies(schema, known):
                answer = admin.post(address, json.dumps(body), content_type="application/json")
                asked += 1
                if answer.status_code >= 500 and answer.status_code not in (503, 504):
                    faults.add(f"{path} {json.dumps(body)[:200]}: {answer.status_code}")
    assert faults == set()
    assert asked > 300


FORMS = ("/login/", "/password/", "/admin/login/", "/admin/auth/user/add/", "/admin/stations/station/add/",
         "/admin/trials/scene/add/", "/admin/trials/checkpoint/add/", "/admin/plans/plan/add/")  # fmt: skip


@pytest.mark.some(1)
@pytest.mark.parametrize("path", FORMS)
def test_in_forms(admin, path):
    if "login" in path:
        admin.logout()
    names = re.findall(r'name="([^"]+)"', admin.get(path).content.decode())
    assert len(names) > 1
    for odd in ODD.values():
        body = "&".join(f"{name}={odd}" for name in names if not name.endswith("_FORMS"))
        answer = admin.post(path, body, content_type="application/x-www-form-urlencoded")
        assert answer.status_code < 500, odd[:20]
