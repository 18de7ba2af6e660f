"""Sentences in other languages: one that a test makes, because none ships."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from django.template import Context, Template, TemplateSyntaxError
from django.test import Client

from evaweb.console.feed import History
from evaweb.core import languages
from evaweb.stations.runtime_client import connection_to
from runtime.core.sentences import Pattern, fixed, to_wire
from runtime.processes.coordinator.session.transitions import SessionEvent

STATIC = Path(__file__).parents[3] / "static"
NODE = shutil.which("node")
WHY = fixed("test.languages.why", "it is late")
HELD = Pattern("test.languages.held", "{holder!r} holds it for {seconds:.1f} s, {percent:g} %: {why:.6}")
WORDS = {
    "test.languages.why": "es ist spät",
    "test.languages.held": "{{{percent:g} %}} {seconds:.2f} s hält {holder!r} es, weil {why}",
    "test.languages.wrong": "{no_such}",
    "lease.held_by": "{holder} hat die Station",
    "stations.leases.nobody_has": "niemand hat {station}",
    "session.changed": "von {before} nach {after}, weil {reason}",
    "state.disconnected": "getrennt",
    "state.idle": "in Ruhe",
    "state.idle.label": "in Ruhe",
    "health.connected": "Bilder kommen an",
    "session.not_allowed": "{command} geht nicht, solange {state} ({reason}); möglich: {allowed}",
}


@pytest.fixture
def german(settings, tmp_path):
    """A language of a folder of its own."""
    settings.LANGUAGES_DIR = tmp_path
    templates = {"home.n": "<b>{n}</b> hat {who}"}
    (tmp_path / "de.json").write_text(
        json.dumps({"name": "Deutsch", "sentences": WORDS, "templates": templates}), "utf-8"
    )
    (tmp_path / "README.md").write_text("no language")
    return languages.language("de")


def shown_by_node(rows):
    """How the pages' script shows each row, once that language is spoken."""
    if NODE is None:
        pytest.skip("Node is not installed: the page's modules are not run")
    script = (
        f"const s = await import({json.dumps((STATIC / 'site' / 'sentences.js').as_uri())});"
        f"const e = await import({json.dumps((STATIC / 'console/live/event_text.js').as_uri())});"
        "const given = JSON.parse((await import('node:fs')).readFileSync(0, 'utf8'));"
        "const show = (row) => row.kind ? e.eventText(row) : row.sentences ? s.localized(row) : s.sentence(row);"
        "const before = given.rows.map(show); s.speak(given.words);"
        "console.log(JSON.stringify([before, given.rows.map(show)]));"
    )
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script],
        input=json.dumps({"rows": rows, "words": WORDS}),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.some(3)
@pytest.mark.parametrize(
    ("said", "words"),
    [
        (
            HELD(holder="ann", seconds=2.345, percent=12.5, why=WHY),
            "{12.5 %} 2.35 s hält 'ann' es, weil es ist spät",
        ),
        (HELD(holder="o'neil", seconds=2, percent=3, why="so"), None),
        (WHY, "es ist spät"),
        (fixed("test.languages.unknown", "no words for it"), "no words for it"),
        (Pattern("test.languages.wrong", "so {much}")(much=1), "so 1"),
        ("a text without an id", "a text without an id"),
    ],
)
def test_server_and_page_say_the_same(german, said, words):
    here = languages.translated(said, german)
    english, there = shown_by_node([to_wire(said)])
    assert english == [said]
    if words is None:  # how each quotes a quote is its own
        assert there[0].startswith("{3 %} 2.00 s hält")
        assert here.startswith("{3 %} 2.00 s hält")
    else:
        assert (here, there[0]) == (words, words)
    assert languages.translated(said, None) == said


@pytest.mark.some(2)
def test_scripts_fill_in_english_as_other_languages_do():
    script = (
        f"const s = await import({json.dumps((STATIC / 'site' / 'sentences.js').as_uri())});"
        "const say = () => [s.t('a.b', '{n} of {{{all:.1f}}}', { n: 3, all: 2 }), s.t('a.c', 'no {n}')];"
        "const before = say(); s.speak({ 'a.b': '{all} hat {n}' }); console.log(JSON.stringify([before, say()]));"
    )
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == [["3 of {2.0}", "no {n}"], ["2 hat 3", "no {n}"]]


def rendered(source, code="", **values):
    request = SimpleNamespace(COOKIES={languages.COOKIE: code})
    return Template(source).render(Context({"request": request, **values}))


def test_templates_say_the_words_of_a_language_with_their_values_escaped(german):
    source = '<p>{% t "home.n" n=found|length who=name %}{{ name }} has {% if found %}some{% endif %}{% endt %}</p>'
    given = {"found": [1, 2], "name": "<i>"}
    assert rendered(source, **given) == "<p>&lt;i&gt; has some</p>"
    assert rendered(source, "de", **given) == "<p><b>2</b> hat &lt;i&gt;</p>"
    assert rendered('{% t "home.other" %}as it is{% endt %}', "de") == "as it is"
    assert Template('{% t "home.n" %}no request{% endt %}').render(Context()) == "no request"
    for wrong in ("{% t home.n %}{% endt %}", '{% t "home.n" 3 %}{% endt %}', "{% t %}{% endt %}"):
        with pytest.raises(TemplateSyntaxError, match="expected"):
            Template(wrong)


def test_words_of_lists_and_choices_have_ids_of_their_own(german):
    words = {"label.to_be_scored": "zu bewerten", "test.languages.why": "es ist spät"}
    spoken = replace(german, patterns=words, templates={"a.b": "{state} ({reason}) von {who}"})
    request = SimpleNamespace(COOKIES={}, _eva_language=spoken)
    trial = SimpleNamespace(get_status_display=lambda: "To be scored")
    given = Context({"request": request, "trial": trial, "why": WHY, "name": "to be scored"})
    source = '{% t "a.b" state=trial.get_status_display reason=why who=name %}x{% endt %}, {% label name %}'
    assert Template(source).render(given) == "zu bewerten (es ist spät) von to be scored, zu bewerten"
    assert languages.label("To be scored", None) == "To be scored"


def test_every_language_that_ships_says_all():
    """Asked of another process: here tests have declared sentences of their own."""
    nothing = {"missing": [], "unknown": [], "other_arguments": []}
    for path in sorted((STATIC / "languages").glob("*.json")):
        command = [sys.executable, "manage.py", "sentences", str(path)]
        done = subprocess.run(command, cwd=STATIC.parent, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout) == {"sentences": nothing, "templates": nothing}


def test_files_that_are_no_language_are_not_offered(german, tmp_path, caplog):
    (tmp_path / "fr.json").write_text("{", "utf-8")
    (tmp_path / "it.json").write_text('{"name": "Italiano", "sentences": {"a.b": 3}}', "utf-8")
    (tmp_path / "NO-code.json").write_text("{}")
    assert [one.code for one in languages.offered()] == ["de"]
    assert "fr.json" in caplog.text
    for code in ("de", "fr", "../de", ""):
        request = SimpleNamespace(COOKIES={languages.COOKIE: code})
        assert (languages.chosen(request) is not None) is (code == "de")


def test_without_a_language_no_choice_is_shown(client, ann, settings, tmp_path):
    settings.LANGUAGES_DIR = tmp_path
    client.force_login(ann)
    assert languages.offered() == []
    assert b"data-language" not in client.get("/").content
    assert client.get("/languages/de.json").status_code == 404


def test_pages_are_in_chinese_for_who_chose_it_and_the_catalogue_is_sent_once(client, ann):
    client.force_login(ann)
    assert '<html lang="en"' in client.get("/").content.decode()
    client.cookies[languages.COOKIE] = "zh-Hans"
    page = client.get("/").content.decode()
    assert '<html lang="zh-Hans"' in page
    assert languages.language("zh-Hans").templates["base.find"] in page
    first = client.get("/languages/zh-Hans.json")
    assert first.json()["sentences"]["label.trial"] == "试验"
    again = client.get("/languages/zh-Hans.json", headers={"If-None-Match": first["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_who_has_chosen_is_refused_in_words(german, live, ann):
    client = Client()
    client.force_login(ann)
    page = client.get("/").content.decode()
    assert 'value="de" data-language-choice' in page
    assert 'data-languages="/languages/_.json"' in page
    assert client.get("/languages/de.json").json() == {"name": "Deutsch", "sentences": WORDS}
    client.cookies[languages.COOKIE] = "de"
    assert 'data-language="de"' in client.get("/").content.decode()
    refused = client.post(
        f"/api/v1/stations/{live.name}/lease", {"action": "request", "page": "p1"}, "application/json"
    )
    said = refused.json()
    assert (refused.status_code, said["id"]) == (409, "stations.leases.nobody_has")
    assert said["error"] == f"{live} has no operator: take it"
    english, there = shown_by_node([{**said, "text": said["error"]}])
    assert (english[0], there[0]) == (said["error"], f"niemand hat {live}")


@pytest.mark.django_db(transaction=True)
def test_a_stations_event_refusal_and_state_are_shown_in_words(german, live, runtime, ann):
    runtime.enter(SessionEvent.CONNECTED, fixed("health.connected", "the robot is connected: press Set up"))
    (event,) = connection_to(live.name).events_since(0)[1]
    assert (event["text"], event["id"]) == (
        "disconnected -> idle: the robot is connected: press Set up",
        "session.changed",
    )
    snapshot = connection_to(live.name).status()

    english, there = shown_by_node([event, snapshot])
    assert english[0] == "disconnected → idle: the robot is connected: press Set up"
    assert there[0] == "von getrennt nach in Ruhe, weil Bilder kommen an"
    assert english[1]["reason"] == snapshot["reason"] == "the robot is connected: press Set up"
    assert (there[1]["reason"], there[1]["state_is"]["label"]) == ("Bilder kommen an", "in Ruhe")
    assert there[1]["state"] == "idle"


def test_events_of_another_version_lose_what_is_no_sentence(live, runtime):
    runtime.emit("held", "so it is")
    row = {"number": 2, "kind": "held", "text": "x", "id": "No Id", "arguments": {"a": []}, "data": {}}
    runtime.do(lambda: runtime.events._events.append(row))

    boot, rows = connection_to(live.name).events_since(0)
    assert [sorted(row) for row in rows][-1] == ["data", "kind", "number", "text"]
    assert History().extended(boot, rows).rows[-1]["text"] == "x"
