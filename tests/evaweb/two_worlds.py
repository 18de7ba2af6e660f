"""The same lab in two worlds that differ in one thing: which of the two checkpoints its blind trial is of.

Whatever reads differently in the two tells it. Clocks, tokens and identifiers that are drawn anew are left out.
"""

from __future__ import annotations

import json
import os
import re
from itertools import zip_longest
from typing import Any
from uuid import UUID

from django.contrib import admin
from django.core.files.uploadedfile import SimpleUploadedFile
from django.db import models, transaction
from django.test import Client
from django.urls import reverse

from evaweb.episodes.exports import write_mcap
from evaweb.episodes.models import Episode, Tag
from evaweb.jobs.models import Job
from evaweb.plans.models import Slot
from evaweb.plans.toml_exchange import export_toml
from evaweb.results.models import Judgement
from evaweb.stations.models import Command
from evaweb.trials.models import Checkpoint, Scene, Trial
from runtime.recording.export import write_export
from tests.evaweb.blind_lab import KEYS, NAMES, in_the_other_world
from tests.evaweb.crawling import _read, crawl_everything
from tests.evaweb.unguarded import without_triggers
from tests.runtime.recording.samples import resealed

MEASURED = "/setup/machine/"  # it says how busy and how full the machine is
OF_A_TRIAL = (Trial, Slot, Command, Episode, Job, Judgement, Tag)  # rows that say which checkpoint it is of


def swap(lab: Any) -> None:
    """Bring the lab into the other world: rows, files, and what its station says."""
    with without_triggers("plans", "trials", "episodes", "results", "stations"):
        for model in OF_A_TRIAL:
            for row in model._default_manager.all():
                _swap_row(row)
    for path in sorted(lab.data.rglob("*")):
        if path.suffix in (".json", ".jsonl", ".txt", ".md", ".log") and path.is_file():
            before = path.stat()
            path.write_text(in_the_other_world(path.read_text()))
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    for folder in lab.data.glob("episodes/*"):  # none before the first run
        resealed(folder)
        write_export(folder, lab.data)
        write_mcap(UUID(folder.name), "video", print)
    lab.swapped = not lab.swapped
    for name in ("trial", "episode", "command"):
        if getattr(lab, name) is not None:
            getattr(lab, name).refresh_from_db()


def _swap_row(row: models.Model) -> None:
    changed = {}
    for field in row._meta.concrete_fields:
        value = getattr(row, field.attname)
        if isinstance(field, models.ForeignKey):
            if field.related_model is Checkpoint and value is not None:
                changed[field.attname] = int(in_the_other_world(str(value)))
        elif not field.primary_key and isinstance(value, (str, dict, list, float)):
            there = json.loads(in_the_other_world(json.dumps(value)))
            if there != value:
                changed[field.attname] = there
    if changed:
        type(row)._default_manager.filter(pk=row.pk).update(**changed)


def _taken_back() -> transaction.Atomic:
    """A transaction that is the test's own: what insists on being no part of another one is, within it."""
    block = transaction.atomic()
    block._from_testcase = True
    return block


def read(
    lab: Any, client: Client, *, administers: bool, every: bool, **asked: Any
) -> list[tuple[str, int, str]]:
    """(what was asked, status, answer) of all that somebody can read, without what is drawn anew."""
    with _taken_back():  # what is sent leaves nothing to the other world
        found = [*crawl_everything(lab, client, **asked)]
        if administers:
            found += administration(client, every)
        transaction.set_rollback(True)
    return [
        (_plain(asked), status, _plain(told))
        for asked, status, told in found
        if not asked.startswith(MEASURED)
    ]


def differences(one: list[tuple[str, int, str]], other: list[tuple[str, int, str]]) -> list[str]:
    """What reads differently, each with the first lines that do."""
    found = []
    for (asked, *here), (_, *there) in zip_longest(one, other, fillvalue=("nothing", 0, "")):
        if here != there:
            lines = zip_longest(str(here[1]).splitlines(), str(there[1]).splitlines(), fillvalue="")
            apart = next((pair for pair in lines if pair[0] != pair[1]), ())
            found.append(
                f"{asked}: {here[0]}, {there[0]}: {' | '.join(line.strip() for line in apart)[:400]}"
            )
    return found


def _plain(text: str) -> str:
    """Without what is drawn or measured for the answer; bytes of a dataset tell less of a name than of its pictures."""
    return re.sub(
        r"[\w-]{40,}|drawing-\d+|nonce[=-][^' >]*|\d\d:\d\d:\d\d\S*|[0-9a-f]{8}-[0-9a-f-]{27}|\d+ (ms|s) ago"
        r'|"(clock|sequence|size)": [\d.]+|Content-Length: \d+',
        "",
        text,
    )


# --- the administration -------------------------------------------------------------------------------------


def administration(client: Client, every: bool) -> Any:
    """(what was asked, status, answer) of every page of it, and of what can be sent to those of checkpoints.

    Of each list every order, filter and date that the page offers, and a search for each name; without `every` of
    checkpoints alone, and of others the list and one of its rows.
    """
    index = reverse("admin:index")
    yield (index, *_asked(client, index))
    for model in sorted(admin.site._registry, key=lambda model: model._meta.label):
        place = f"admin:{model._meta.app_label}_{model._meta.model_name}"
        listed = reverse(f"{place}_changelist")
        status, told = _asked(client, listed)
        yield listed, status, told
        whole = every or model is Checkpoint
        offered = set(re.findall(r'href="(\?[^"#]+)"', told)) if whole else set()
        for query in sorted(offered):
            yield (listed + query, *_asked(client, listed + query.replace("&amp;", "&")))
        for name in NAMES if model in (Checkpoint, Scene) else ():
            yield (f"{listed}?q={name}", *_asked(client, f"{listed}?q={name}"))
        if whole:
            yield (reverse(f"{place}_add"), *_asked(client, reverse(f"{place}_add")))
        for row in model._default_manager.order_by("pk")[: 3 if whole else 1]:
            for page in ("change", "delete", "history") if whole else ("change",):
                address = reverse(f"{place}_{page}", args=[row.pk])
                yield (address, *_asked(client, address))
    yield from _sent(client)


def _asked(client: Client, address: str) -> tuple[int, str]:
    return _read(client.get(address, headers={"Accept": "text/html"}))


def _sent(client: Client) -> Any:
    """What is said to changes of a checkpoint: in its form, by a file, and to its removal, alone and with the other."""
    listed, wanted = reverse("admin:trials_checkpoint_changelist"), reverse("admin:plans_plan_import")
    for row in Checkpoint.objects.filter(pk__in=KEYS).order_by("pk"):
        form = {
            "name": row.name,
            "description": "another",
            "policy": '{"url": "ws://127.0.0.1:1"}',
            "tags": "",
        }
        deleted = reverse("admin:trials_checkpoint_delete", args=[row.pk])
        text = export_toml(checkpoints=[row]).replace('description = ""', 'description = "another"')
        for address, content in (
            (reverse("admin:trials_checkpoint_change", args=[row.pk]), form),
            (deleted, {"post": "yes"}),
            (listed, {"action": "delete_selected", "_selected_action": [row.pk]}),
            (listed, {"action": "switch_off", "_selected_action": [row.pk]}),
            (wanted, {"file": SimpleUploadedFile("lab.toml", text.encode())}),
        ):
            with _taken_back():
                answer = client.post(address, content, follow=True, headers={"Accept": "text/html"})
                yield (f"POST {address} {row.pk} {content.get('action', '')}", *_read(answer))
                transaction.set_rollback(True)
