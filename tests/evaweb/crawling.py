"""Everything that somebody can read of a lab: every named address, the answers to orders, and the live socket."""

from __future__ import annotations

import asyncio
import io
import json
import re
import uuid as uuids
import zipfile
from functools import partial
from typing import Any

import pyarrow.parquet as pq
from django.urls import get_resolver, reverse

from evaweb.jobs.models import Job
from evaweb.plans.models import Reference
from evaweb.preflights.models import Preflight
from tests.evaweb.blind_lab import AIM, KEYS, NAMES, SECRETS
from tests.evaweb.console.page import Page
from tests.processes import eventually

MARKS = ("execution_horizon", "something_new", '"targets"')  # only the live socket has them
CRATES = (
    *("imported-crate", "imported-crate-file", "imported-crate-remove"),
    *("api:imported-crate", "api:imported-crate-file"),
)
ROUNDS = 4  # of what the live socket is given to tell
STREAMS = ["state", "joints", "recent", "poses", "chunk", "camera/cam_high"]


def addresses(lab):
    """Of every address there is but those of administration: the ways to fill it in with what there is in the lab."""
    preflight = Preflight.objects.first().pk
    values = {
        "id": {
            "preflight": [preflight],
            "api:preflight": [preflight],
            "api:job-retry": [job.pk for job in Job.objects.all()[:1]] or [1],
            "api:job-cancel": [job.pk for job in Job.objects.all()[:1]] or [1],
            "reference": [row.pk for row in Reference.objects.all()[:1]] or [1],
            "api:reference-regions": [row.pk for row in Reference.objects.all()[:1]] or [1],
            "": [lab.trial.pk if lab.trial else 1],
        },
        "uuid": {"": [lab.episode.uuid if lab.episode else uuids.uuid4()]},
        "segment": {"": [uuids.uuid4()]},
        "version": {"": [1]},
        "camera": {"": ["cam_high"]},
        "code": {"": ["xx"]},
        "format": {"": ["table", "mcap-video"]},
        "index": {"": [0]},
        "robot": {"": ["agilex_piper"]},
        "digest": {
            "": [(lab.plan.at_reveal or {}).get("digest", "0" * 64)],
            **{name: [lab.crate.sha256] for name in CRATES},
        },
        "checkpoint": {"": KEYS},
        "rest": {"": ["nowhere"]},
        "file": {"": ["eva-diagnosis-20260101-000000.zip"]},
        "name": {
            "picture": ["0" * 64],
            "api:scene": [lab.scene.name],
            "setup-scene": [lab.scene.name],
            "setup-sheet": [lab.scene.name],
            "api:checkpoint": KEYS,
            "": [lab.station.name, lab.plan.name, *filter(None, [lab.dataset])],
        },
    }
    for name, converters in sorted(named(get_resolver())):
        yield list(filled(name, converters, values))


def named(resolver, space=""):
    """(name, parameters) of every address, administration left out."""
    for entry in resolver.url_patterns:
        if hasattr(entry, "url_patterns"):
            if entry.namespace != "admin":
                yield from named(entry, space + (f"{entry.namespace}:" if entry.namespace else ""))
        elif entry.name and entry.name != "openapi":  # which says the same to everybody
            yield space + entry.name, tuple(sorted(entry.pattern.converters))


def filled(name, parameters, values):
    choices: list[dict[str, Any]] = [{}]
    for parameter in parameters:
        assert parameter in values, f"{name} has the parameter {parameter}: say here what to fill in"
        own = values[parameter]
        fits = own.get(name) or own.get("")
        assert fits is not None, f"{name} has the parameter {parameter}: say here what to fill in"
        choices = [{**choice, parameter: value} for choice in choices for value in fits]
    for choice in choices:
        yield reverse(name, kwargs=choice)


QUERIES = ("?format=csv", "?inactive=true", "?state=frozen", "?plan=blocks")
WANTED = "?name=datasets/{}&first={}&second={}&checkpoint={}&show={}"  # what some addresses must be told
NOTHING = (400, 404, 405, 422)  # nothing else is said there for another question
ORACLES = (
    ("checkpoint", KEYS),
    ("checkpoint", NAMES),
    ("words", NAMES),
    ("tag", [f"{name}-slips" for name in NAMES]),
)
UNCOVERS = re.compile(r"/(reveal|look)/?$")  # for whoever may: what is told after it is theirs to know
LIST = re.compile(
    r"^/(?!.*(/\d+(/|$)|[0-9a-f]{8}-[0-9a-f]{4}-))"
)  # an address in which no one thing is named


def crawled(lab, client, queries=(), *, posts=False, uncovers=True):
    """(address, status, what it answers) of everything, headers and names of files included.

    Each kind of page is asked for one thing that it answers for, and for all where it answers for none; with `posts`
    those that are only posted to are sent nothing, without `uncovers` but a reveal and a look.
    """
    for address in files(lab):
        yield address, *answered(client, address)
    wanted = WANTED.format(lab.dataset, *KEYS, KEYS[0], lab.episode.uuid if lab.episode else "")
    for choices in addresses(lab):
        for address in choices:
            status, told = answered(client, address)
            yield address, status, told
            if status in (400, 422) or (status == 404 and len(choices) == 1):
                address += wanted
                status, told = answered(client, address)
                yield address, status, told
            kept = address.endswith("/logout/") or (UNCOVERS.search(address) and not uncovers)
            if status == 405 and posts and not kept:
                yield f"POST {address}", *posted(client, address, {})
            if status in NOTHING:
                continue
            for query in queries if LIST.search(address) else ():
                yield address + query, *answered(client, address + query, {"HX-Request": "true"})
            break


def files(lab):
    """Addresses of files that have to be told a licence."""
    plan = [lab.plan.name, lab.plan.version]
    yield from (f"{reverse(name, args=plan)}?license=MIT" for name in ("result-crate", "api:plan-crate"))


def answered(client, address, headers=None):
    """Status, and body and headers as one text."""
    return _read(client.get(address, headers={"Accept": "text/html", **(headers or {})}))


def posted(client, address, content):
    """The same of what is posted as JSON."""
    return _read(client.post(address, json.dumps(content), content_type="application/json"))


def _read(answer):
    body = b"".join(_pieces(answer)) if answer.streaming else answer.content
    told = _opened(body) + "\n".join(f"{key}: {value}" for key, value in answer.headers.items()).encode()
    return answer.status_code, told.decode("utf-8", "replace")


def _pieces(answer):
    if not answer.is_async:
        return list(answer.streaming_content)

    async def collected():
        return [piece async for piece in answer.streaming_content]

    return asyncio.run(collected())


def _opened(body):
    """What is packed, unpacked."""
    if body.startswith(b"PK\x03\x04"):
        with zipfile.ZipFile(io.BytesIO(body)) as packed:
            return b"".join(name.encode() + _opened(packed.read(name)) for name in packed.namelist())
    if body.startswith(b"PAR1"):
        table = pq.read_table(io.BytesIO(body))
        return f"{table.schema.metadata} {table.to_pylist()}".encode()
    return body


def find_leaks(lab, client, queries=(), *, posts=False):
    """Where a secret can be read by somebody who has not said it, one after the other."""
    yield from secrets_in(crawl_everything(lab, client, queries, posts=posts))


def secrets_in(answers):
    """Each secret that was told to somebody who had not said it: (what was asked, secret)."""
    for asked, _, told in answers:
        yield from ((asked, secret) for secret in SECRETS if secret in told and secret not in asked)


def crawl_everything(lab, client, queries=(), *, posts=False, uncovers=True):
    """What is answered to orders, then everything that can be read; without `uncovers` nobody reveals or looks."""
    for path, content in orders(lab) if lab.command is not None else ():
        if uncovers or not UNCOVERS.search(path):
            yield f"POST {path} {json.dumps(content)}", *posted(client, path, content)
    yield from crawled(lab, client, queries, posts=posts, uncovers=uncovers)


def orders(lab):
    """What an operator may send, and what could come back with a name in it."""
    order = {"kind": "setup", "page": "p1", "uuid": str(lab.command.pk), "trial": lab.trial.pk}
    yield reverse("api:commands", args=[lab.station.name]), order
    yield reverse("api:commands", args=[lab.station.name]), {**order, "uuid": str(uuids.uuid4())}
    pk = KEYS[0]
    yield (
        reverse("api:prepare", args=[lab.station.name]),
        {"scene": lab.scene.name, "position": 1, "checkpoint": pk},
    )
    yield reverse("api:preflight-ask"), {"checkpoint": pk}
    yield reverse("api:plan-next", args=[lab.plan.name]), {"station": lab.station.name}
    yield reverse("api:plan-reveal", args=[lab.plan.name]), {}


def distinguishable(lab, client):
    """Lists that answer differently to who asks for the one checkpoint and for the other.

    What was asked for is taken out of the answers, and what is drawn for each anew.
    """
    for address in [one for choices in addresses(lab) for one in choices if LIST.search(one)]:
        if answered(client, address)[0] in NOTHING:
            continue
        for key, values in ORACLES:
            ask = partial(_answer_to, client, address, key)
            said = eventually(partial(_unless_changed, ask, values), f"{address} changes no more by itself")
            if len(said) > 1:
                yield f"{address}?{key}="


def _answer_to(client, address, key, value):
    return _plain(answered(client, f"{address}?{key}={value}"), str(value))


def _unless_changed(ask, values):
    """The different answers; None where the same question is not answered alike before and after the others.

    What an e-stop of before has ended may be written down meanwhile: that is no answer to a question.
    """
    first, *others = [ask(value) for value in (*values, values[0])]
    return {first, *others} if first == others[-1] else None


def _plain(answer, asked):
    status, told = answer
    return status, re.sub(
        r"[\w-]{40,}|drawing-\d+|nonce[=-][^' >]*|\d\d:\d\d:\d\d\S*", "", told.replace(asked, "")
    )


async def heard(lab, user):
    """Everything that the live socket sends, texts and headers as one text and the arrays as bytes.

    It is read until what the station says last has come, and frames with what was published before that.
    """
    page = await Page(lab.station.name, user).open()
    await page.say(type="watch", streams=STREAMS)
    await page.say(type="events", after=0, boot="")
    for _ in range(ROUNDS):
        await asyncio.to_thread(lab.publish)
        await page.shown(lambda streams: "joints" in streams)
    last = f"that was all ({uuids.uuid4()})"
    await asyncio.to_thread(lab.runtime.emit, "camera_back", last)
    await page.told("events", lambda told: told["events"][-1]["text"] == last)
    await page.shown(lambda streams: "recent" in streams)
    await page.close()
    said = json.dumps(page.texts + [frame.header for frame in page.frames])
    return said, b"".join(frame.body for frame in page.frames)


def websocket_texts(lab, user):
    """Which secrets the live socket told."""
    said, arrays = asyncio.run(heard(lab, user))
    wanted = ["what the policy wants"] if AIM.tobytes() in arrays else []
    return [mark for mark in (*SECRETS, *MARKS) if mark in said] + wanted
