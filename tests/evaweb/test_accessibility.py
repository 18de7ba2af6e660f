"""axe-core finds nothing on any page that needs no station, filled with data, at four sizes and in both themes."""

from pathlib import Path

import pytest
from django.conf import settings
from django.contrib.admin import site
from django.test import Client
from django.urls import reverse
from playwright.sync_api import sync_playwright

from evaweb.plans.services import reveal_plan
from tests.e2e.axe import SIZES, themed, violations
from tests.e2e.lab import CHROMIUM, NO_CHROMIUM, browsing
from tests.evaweb.blind_lab import BlindLab
from tests.evaweb.crawling import addresses
from tests.evaweb.episodes.conftest import recorded  # noqa: F401  a fixture

pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.slow, pytest.mark.exhaustive]


@pytest.fixture
def lab(live, runtime, ann, recorded, tmp_path, monkeypatch):  # noqa: F811
    """A plan that was revealed, its trial, an episode and a dataset."""
    monkeypatch.setattr("django.conf.settings.DATA_DIR", tmp_path)
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)
    lab = BlindLab(live, runtime, ann, recorded["finished"], tmp_path)
    for stage in ("allocate", "running", "failed", "scored", "closed"):
        getattr(lab, stage)()
    lab.plan = reveal_plan(user=lab.owner, plan=lab.plan)
    return lab


def pages(lab, client):
    """The addresses that answer an administrator with a page."""
    for choices in [*addresses(lab), *([address] for address in administration())]:
        for address in choices:
            if not address.startswith("/api/") and "logout" not in address and is_page(client, address):
                yield address
                break


def is_page(client, address):
    answer = client.get(address, headers={"Accept": "text/html"})
    if answer.status_code != 200 or not answer["Content-Type"].startswith("text/html"):
        return False
    return b"<html" in answer.content


def administration():
    """Of every kind of thing in the administration: the list, a new one, and the first there is."""
    for model in site._registry:
        name = f"admin:{model._meta.app_label}_{model._meta.model_name}"
        yield from (reverse(f"{name}_changelist"), reverse(f"{name}_add"))
        if first := model._default_manager.order_by("pk").first():
            yield reverse(f"{name}_change", args=[first.pk])


@pytest.mark.skipif(not Path(CHROMIUM).exists(), reason=NO_CHROMIUM)
def test_axe_finds_nothing(lab, alma, live_server):
    client = Client()
    client.force_login(alma)
    session = settings.SESSION_COOKIE_NAME
    cookie = {"name": session, "value": client.cookies[session].value, "url": live_server.url}
    wanted = list(pages(lab, client))
    assert len(wanted) > 60
    found = {}
    with sync_playwright() as playwright, browsing(playwright) as browser:
        for theme, asked in (("light", {}), ("dark", {"sizes": SIZES[1:2], "colours": True})):
            context = browser.new_context()
            context.add_cookies([cookie])
            themed(context, theme)
            page = context.new_page()
            for address in wanted:
                page.goto(live_server.url + address)
                sizes = {} if "/admin/" not in address or asked else {"sizes": SIZES[1::2]}
                for said, widths in violations(page, **asked, **sizes).items():
                    found.setdefault(said, []).append((theme, address, widths))
    assert found == {}
