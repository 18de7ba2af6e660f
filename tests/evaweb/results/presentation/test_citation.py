"""A result that travels: what the reveal kept, as text, LaTeX and SVG, at an address that does not change."""

import json
import re
from xml.etree import ElementTree

import pytest
from django.db import transaction
from django.test import Client

from evaweb.plans.design import reveal_record
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.results.analysis.wording import p_words
from evaweb.results.presentation.citation import _looks, citation
from evaweb.results.presentation.latex import escaped, foreign
from evaweb.statistics.boundaries import boundary, pair_counts
from evaweb.statistics.designs import Design
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Evaluation
from tests.evaweb.trials import builders

FORMS = {"txt": "text/plain", "tex": "application/x-tex", "svg": "image/svg+xml"}
# All that LaTeX may be given: plain letters, commands with their ends, and nothing else that it acts upon.
PLAIN = re.compile(
    r"""(?:[A-Za-z0-9 .,:;!?()\[\]/*+=@-]|[^\x00-\x7f]|\\[{}%_&#$]|\\[A-Za-z]+\{\}|\\[`'^~="a-zA-Z.]\{[A-Za-z]\}"""
    r"""|\$[-A-Za-z\\^{}0-9]+\$|-\{\}-|\{\}|~)*"""
)


@pytest.fixture
def client(db):
    made = Client()
    made.force_login(builders.user("vera", "viewer"))
    return made


@pytest.fixture
def address(revealed):
    return f"/result/frozen/{revealed.at_reveal['digest']}/"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("a_b & c% #1 $x$ {y}", r"a\_b \& c\% \#1 \$x\$ \{y\}"),
        ("~^\\", r"\textasciitilde{}\textasciicircum{}\textbackslash{}"),
        ("a<b>c|d", r"a\textless{}b\textgreater{}c\textbar{}d"),
        ("pi0--new---", r"pi0-{}-new-{}-{}-"),
        ("Müller, Łódź, ñ, ç", r"M\"{u}ller, \L{}\'{o}d\'{z}, \~{n}, \c{c}"),
        ("λ Ω − ×", r"$\lambda$ $\Omega$ $-$ $\times$"),
        ("e\u0301", r"\'{e}"),
        ("one\ntwo\x00\u200b", "one two  "),
        ("方块", "方块"),
        ("\\input{/etc/passwd}", r"\textbackslash{}input\{/etc/passwd\}"),
    ],
)
def test_what_was_typed_is_printed_and_never_run(typed, said):
    assert escaped(typed) == said
    assert PLAIN.fullmatch(said), said


def test_no_letter_at_all_gets_by():
    every = "".join(map(chr, [*range(0x250), *range(0x370, 0x400), *range(0x2000, 0x2300), 0x65B9, 0x1F600]))
    for letter in every:
        assert PLAIN.fullmatch(escaped(letter)), (letter, escaped(letter))


def test_letters_that_need_another_latex_are_named():
    assert foreign("Müller 方 λ") == ["方"]


def test_the_sentence_names_the_design_and_the_table_has_n_rate_interval_and_score(revealed):
    cited = citation(revealed)
    assert cited.text["sentence"].startswith(cited.sentence)
    assert cited.sentence.startswith(("pi0-new succeeded more often than", "No significant difference"))
    assert "Design: fixed, one test at the end, 8 pairs foreseen, alpha 0.05" in cited.text["sentence"]
    assert revealed.at_reveal["digest"] in cited.text["sentence"]
    setting = (
        r'16 trials on agilex_piper \(simulated\) at bench-1.*, 20\d\d-\d\d-\d\d; .*"; scored by ann \(\d+\)'
    )
    assert re.search(setting, cited.text["sentence"])
    assert "scored by ann" in cited.svg
    rows = {row.checkpoint: row.cells for row in cited.rows}
    assert rows["pi0-new"][1:3] == ("8", "6")
    assert re.fullmatch(r"75 % \[\d+, \d+\]", rows["pi0-new"][3])
    assert rows["pi0-new"][4] == "0.88"
    assert "pi0-block" in cited.text["table"]
    assert r"75 \% [" in cited.latex["table"]
    assert cited.latex["table"].count(r"\hline") == 3
    assert cited.latex["figure"].count(r"\circle*") == 2


def test_the_figure_needs_nothing_beside_it(revealed):
    svg = citation(revealed).svg
    root = ElementTree.fromstring(svg)
    tags = {each.tag.removeprefix("{http://www.w3.org/2000/svg}") for each in root.iter()}
    assert tags <= {"svg", "title", "desc", "rect", "g", "text", "path"}
    assert not any({"class", "style", "href", "id"} & set(each.attrib) for each in root.iter())
    colours = {each.get(name) for each in root.iter() for name in ("fill", "stroke")} - {None, "none"}
    assert all(re.fullmatch(r"#(\w\w)\1\1", colour) for colour in colours)
    assert svg == citation(revealed).svg


def test_what_is_corrected_later_changes_no_byte(revealed, bench, client, address):
    before = {form: client.get(f"{address}result.{form}") for form in FORMS}
    told = client.get(f"/api/v1/results/frozen/{revealed.at_reveal['digest']}").json()
    for handout in revealed.handouts.all():
        ticks = bench.ticks(True, True, True)
        services.score_trial(user=bench.operator, trial=handout.trial, milestones=ticks, reason="seen again")
    for form, kind in FORMS.items():
        answer = client.get(f"{address}result.{form}")
        assert answer.content == before[form].content
        assert answer.headers["Content-Type"] == f"{kind}; charset=utf-8"
        name = f"blocks-v1-{revealed.at_reveal['digest'][:8]}.{form}"
        assert answer.headers["Content-Disposition"] == f'attachment; filename="{name}"'
    assert client.get(f"/api/v1/results/frozen/{revealed.at_reveal['digest']}").json() == told
    page = client.get(address).content.decode()
    assert "Scores were corrected after the reveal" in page
    assert told["headline"] in page
    assert (told["digest"], told["blocks"]) == (revealed.at_reveal["digest"], revealed.at_reveal["blocks"])
    assert told["key"] == bytes(revealed.key).hex()
    assert told["later"] == "/api/v1/plans/blocks/1/integrity"


def test_neither_the_labs_name_nor_that_of_who_revealed_changes_it(
    revealed, owner, client, address, settings
):
    settings.ALLOWED_HOSTS = ["*"]
    digest = revealed.at_reveal["digest"]
    places = [*(f"{address}result.{form}" for form in FORMS), f"/api/v1/results/frozen/{digest}"]
    before = [client.get(place).content for place in places]
    assert f"digest {digest}: {address}\n" in before[0].decode()
    owner.username = "olga-married"
    owner.save()
    assert [client.get(place, HTTP_HOST="other.lab:9999").content for place in places] == before
    assert client.get(places[-1]).json()["revealed_by"] == "olga"


def test_what_is_cited_is_of_the_first_reveal_whatever_backup_was_put_back(owner, bench, client, carry_out):
    new = Checkpoint.objects.create(name="pi0-new", policy={})
    draft = Plan.objects.create(
        name="back", title="Back", owner=owner, repetitions=1, first=new, second=bench.checkpoint
    )
    draft.checkpoints.set([new, bench.checkpoint])
    draft.positions.set(bench.scene.positions.all())
    with transaction.atomic():
        plan = freeze_plan(user=owner, plan=Plan.objects.get(pk=draft.pk))
        carry_out(plan, 4)
        first = reveal_plan(user=owner, plan=plan)
        digest = first.at_reveal["digest"]
        places = [f"/api/v1/results/frozen/{digest}"]
        places += [f"/result/frozen/{digest}/result.{form}" for form in FORMS]
        shown = [client.get(place).content for place in places]
        transaction.set_rollback(True)  # the backup is from before it was frozen
    Evaluation.objects.create(name="back", version=1)  # as the trials on the disk make it
    root = builders.user("root", "admin")
    plan = freeze_plan(user=root, plan=Plan.objects.get(pk=draft.pk))
    again = reveal_plan(user=root, plan=plan)
    assert (again.at_reveal, again.key == first.key) == (first.at_reveal, False)
    assert [client.get(place).content for place in places] == shown
    told = json.loads(shown[0])
    assert (told["key"], told["revealed_by"]) == (bytes(first.key).hex(), "olga")
    page = client.get(f"/result/frozen/{digest}/").content.decode()
    assert told["key"] in page
    assert told["commitment"] in page
    assert again.commitment not in page


def test_a_reveal_from_before_its_key_was_kept_is_cited_with_the_plans_own(revealed):
    kept = {
        name: value for name, value in revealed.at_reveal.items() if name not in ("by", "commitment", "key")
    }
    told = citation(revealed).document
    revealed.at_reveal = kept
    assert citation(revealed).document == told


def test_a_correction_of_points_alone_is_said_too(revealed, bench, client, address):
    said = "Scores were corrected after the reveal"
    assert said not in client.get(address).content.decode()
    trial = revealed.handouts.filter(trial__verdict__success=False).first().trial
    reached = not trial.verdict.outcomes.get(order=1).reached
    services.score_trial(
        user=bench.operator, trial=trial, milestones=bench.ticks(reached, reached, False), reason="seen again"
    )
    assert said in client.get(address).content.decode()


def test_the_plan_leads_to_its_address_and_no_other_digest_to_anything(revealed, client, address):
    assert client.get("/result/plans/blocks/1/cite/").headers["Location"] == address
    assert 'href="/result/plans/blocks/1/cite/"' in client.get("/result/plans/blocks/1/").content.decode()
    for wrong in ("/result/frozen/" + "0" * 64 + "/", "/api/v1/results/frozen/" + "0" * 64):
        assert client.get(wrong).status_code == 404
    assert Client().get(address).status_code == 302
    assert Client().get(f"/api/v1/results/frozen/{revealed.at_reveal['digest']}").status_code == 401


def test_before_the_reveal_there_is_nothing_to_cite(plan, owner, carry_out, client):
    carry_out(plan, 16)
    address = "/result/plans/blocks/1/cite/"
    page = client.get(address).content.decode()
    assert "Sealed" in page
    assert "pi0-new" not in page
    plan.refresh_from_db()
    digest = reveal_record(plan)["digest"]  # that it will have: not known, and worth nothing
    assert client.get(f"/result/frozen/{digest}/").status_code == 404
    reveal_plan(user=owner, plan=plan)
    assert client.get(f"/result/frozen/{digest}/").status_code == 200


def test_it_is_sealed_while_another_blind_plan_compares_the_same_checkpoint(
    revealed, owner, bench, client, address
):
    again = Plan.objects.create(name="again", title="Again", owner=owner)
    again.checkpoints.set([bench.checkpoint])
    again.positions.set(bench.scene.positions.all())
    freeze_plan(user=owner, plan=again)
    page = client.get(address).content.decode()
    assert "Sealed" in page
    for answer in (
        *(client.get(f"{address}result.{form}") for form in FORMS),
        client.get(f"/api/v1/results/frozen/{revealed.at_reveal['digest']}"),
        client.get("/api/v1/plans/blocks/1/integrity"),
    ):
        assert answer.status_code == 403
        assert "pi0-new" not in answer.content.decode()
    assert "pi0-new" not in page + client.get("/result/plans/blocks/1/integrity/").content.decode()


@pytest.mark.exhaustive
def test_an_open_plan_that_has_ended_is_cited_as_it_is_now(plan, owner, bench, carry_out, client):
    other = Plan.objects.create(
        name="open",
        title="Open",
        owner=owner,
        blind=False,
        first=plan.first,
        second=plan.second,
        repetitions=1,
    )
    other.checkpoints.set([plan.first, plan.second])
    other.positions.set(bench.scene.positions.all())
    carry_out(plan, 16)
    reveal_plan(user=owner, plan=plan)
    freeze_plan(user=owner, plan=other)
    carry_out(other, 2)
    address = "/result/plans/open/1/cite/"
    going_on = client.get(address)
    assert (
        going_on.status_code,
        "a result is cited once the plan is closed" in going_on.content.decode(),
    ) == (409, True)
    close_plan(user=owner, plan=other, reason="enough")
    page = client.get(address).content.decode()
    assert "As it is now: a correction changes it" in page
    assert "were not compared: closed after 1 of 2 pairs" in page


def test_a_p_below_all_that_is_told_has_one_sign():
    assert [p_words(p) for p in (0.0001, 0.0123, 0.5)] == ["p < 0.001", "p = 0.012", "p = 0.50"]


def test_a_reveal_that_kept_its_pairs_alone_is_cited_by_them(revealed):
    pairs = [[value for _, value in sorted(block)] for block in revealed.at_reveal["blocks"]]
    revealed.at_reveal = {"pairs": pairs, **{name: revealed.at_reveal[name] for name in ("digest", "at")}}
    rows = {row.checkpoint: row.cells for row in citation(revealed).rows}
    assert rows["pi0-new"][1:3] == ("8", "6")
    assert rows["pi0-new"][4] == "–"


@pytest.mark.parametrize(
    ("looks", "said"),
    [(None, "after every pair"), ([18, 19, 20], "after 18, 19, 20 pairs"), ([10], "after 10, 20 pairs")],
)
def test_looks_that_were_named_are_cited_as_they_were_also_where_they_follow_each_other(looks, said):
    design = Design("late", 20, 0.05, boundary=boundary(pair_counts(20, looks)))
    assert _looks(design) == f"looked at {said}"
