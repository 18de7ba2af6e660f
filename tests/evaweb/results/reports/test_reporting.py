import csv
import html
import json
import os
import shutil
import subprocess
import sys

import pytest
from django.core.management import CommandError, call_command

from evaweb.core.canonical_json import digest
from evaweb.core.errors import Conflict
from evaweb.plans import image_store
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Achieved, Plan, Reference
from evaweb.plans.services import freeze_plan, reveal_plan
from evaweb.results.analysis.agreement import preference_comparisons
from evaweb.results.models import Judgement
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings import rating_queue
from evaweb.results.reports.checklist import checklist
from evaweb.results.reports.recompute.sealed import faults
from evaweb.results.reports.reporting import plan_seal, write_report
from evaweb.trials import services, voids
from evaweb.trials.corrections import trial_failure
from evaweb.trials.models import Checkpoint
from tests.evaweb.plans.lab import jpeg
from tests.evaweb.played import played
from tests.evaweb.trials import builders


def recompute(folder):
    """What the report's own program says, with no package within reach."""
    words = [sys.executable, "-E", "-s", "-S", "-m", "recompute"]
    return subprocess.run(words, cwd=folder, env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)


@pytest.fixture
def report(revealed, tmp_path, bench):
    played("report", lambda: _reported(revealed, tmp_path, bench))
    return tmp_path / "report"


def _reported(revealed, tmp_path, bench):
    rater = builders.user("rita")
    for index, handout in enumerate(
        revealed.handouts.filter(slot__index__in=rating_queue.rating_sample(revealed))
    ):
        last = (
            index % 2 == 0 if index else not handout.trial.scores.latest("pk").success
        )  # which trials they are is drawn: one differs
        milestones = bench.ticks(True, True, last)
        rating_queue.save_rating(user=rater, plan=revealed, code=handout.code, milestones=milestones)
    for index in range(8):
        pair, _ = rating_queue.next_to_compare(rater, [revealed])[:2]
        codes = {"first": pair.first.code, "second": pair.second.code}
        # By checkpoint and not by place, which is drawn: where one wins every time, there is nothing to fit.
        won_by_new = index % 4 in (0, 3)
        new_is_first = pair.first.slot.checkpoint.name == "pi0-new"
        outcome = "tie" if index % 4 == 2 else "first" if won_by_new == new_is_first else "second"
        rating_queue.save_preference(user=rater, plan=revealed, outcome=outcome, why="smoother", **codes)
    rating_queue.save_preference(
        user=builders.user("rob"), plan=revealed, outcome="tie", why="alike", **codes
    )
    for number, handout in enumerate(revealed.handouts.order_by("number")):
        judged_by_machine(handout.trial, number)
    call_command("eval_report", "blocks", "--out", str(tmp_path / "report"))


def judged_by_machine(trial, number):
    """What two judges say of it: one a little of everything, one never anything."""
    words = [
        [text, number % 3 > 0, 0.9 - 0.01 * number if number % 3 else 0.3] for text in ("held", "lifted")
    ]
    words.append(["on the plate", None, None])
    Judgement.objects.create(trial=trial, judge="=seer", version="chat 1, x", milestones=words)
    nothing = [[text, None, None] for text, *_ in words]
    Judgement.objects.create(trial=trial, judge="mute", version="1", milestones=nothing, reason="HTTP 500")


def test_a_program_without_us_computes_every_number_again(report):
    found = recompute(report)
    assert found.returncode == 0, found.stdout + found.stderr
    numbers = json.loads((report / "data" / "numbers.json").read_text("utf-8"))
    assert numbers["n"] == 16
    assert numbers["agreement"]["ratings"] == 8
    assert numbers["preferences"]["n"] == 9
    assert sorted(row.weight for row in preference_comparisons(Plan.objects.get())) == [0.5, 0.5, *[1.0] * 7]
    modes = [mode for arm in numbers["arms"].values() for mode in arm["failure_modes"]]
    assert {(mode["failure_phase"], mode["failure"]) for mode in modes} == {("", "=dropped")}
    assert sum(mode["count"] for mode in modes) == 16 - sum(a["successes"] for a in numbers["arms"].values())
    why = (
        (report / "index.html").read_text("utf-8").partition("Why they failed")[2].partition("</section>")[0]
    )
    assert why.count('<svg class="drawing pareto"') == 2
    assert "href" not in why
    seer, mute = numbers["judges"]
    assert (seer["judge"], seer["milestones"]["held"]["agreement"]["n"], seer["calibration"]["n"]) == (
        "=seer",
        16,
        32,
    )
    assert (mute["no_verdict"], mute["calibration"]) == ({"HTTP 500": 16}, None)
    assert "schedule and codes: 0 do not come out" in found.stdout


def test_what_was_corrected_after_the_second_rating_is_recomputed_as_it_stood(
    report, revealed, bench, tmp_path
):
    for trial in [handout.trial for handout in revealed.handouts.all() if handout.trial.ratings.exists()]:
        ticks = bench.ticks(*(reached for _, reached in trial.ratings.get().milestones))
        services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="the other is right")
    call_command("eval_report", "blocks", "--out", str(tmp_path / "later"))
    found = recompute(tmp_path / "later")
    assert found.returncode == 0, found.stdout + found.stderr
    earlier, later = (
        json.loads((tmp_path / name / "data" / "numbers.json").read_text("utf-8"))["agreement"]
        for name in ("report", "later")
    )
    assert later == earlier
    assert earlier["success"]["same"] < 8


WAYS = (
    ("arms", "pi0-new", "wilson", 0),
    ("arms", "pi0-new", "time_to_success", "restricted_mean", "value_s"),
    ("arms", "pi0-new", "smoothness", "student", 1),
    ("arms", "pi0-block", "smoothness_commanded", "mean"),
    ("comparisons", 0, "barnard", "p"),
    ("comparisons", 0, "evidence", "log_e_first", 3),
    ("comparisons", 0, "anytime", "success", 0),
    ("agreement", "success", "ac1"),
    ("judges", 0, "milestones", "held", "agreement", "kappa"),
    ("judges", 0, "milestones", "lifted", "brier"),
    ("judges", 0, "calibration", "error"),
    ("judges", 0, "calibration", "bins", 1, "probability"),
    ("judges", 1, "no_verdict", "HTTP 500"),
    ("preferences", "contrasts", 0, "difference"),
    ("letters", "pi0-new"),
)


@pytest.mark.exhaustive
def test_a_number_that_was_changed_is_named(report):
    path = report / "data" / "numbers.json"
    right = path.read_text("utf-8")
    for way in WAYS:
        numbers = json.loads(right)
        place = numbers
        for key in way[:-1]:
            place = place[key]
        place[way[-1]] = "z" if way[0] == "letters" else place[way[-1]] + 0.01
        path.write_text(json.dumps(numbers), "utf-8")
        found = recompute(report)
        assert found.returncode == 1, way
        name = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in way)[1:]
        assert f"{name}: " in found.stdout


def test_an_interval_that_was_drawn_and_is_narrowed_is_named(report):
    path = report / "data" / "numbers.json"
    numbers = json.loads(path.read_text("utf-8"))
    low, high = numbers["arms"]["pi0-new"]["macro"]["gaffke"]
    numbers["arms"]["pi0-new"]["macro"]["gaffke"] = [low + 0.15, high]
    path.write_text(json.dumps(numbers), "utf-8")
    assert "arms.pi0-new.macro.gaffke: " in recompute(report).stdout


def test_a_trial_that_was_taken_out_or_of_another_checkpoint_is_found(report):
    path = report / "data" / "trials.csv"
    lines = path.read_text("utf-8").splitlines(keepends=True)
    path.write_text("".join(lines[:-1]), "utf-8")
    assert recompute(report).returncode == 1
    swapped = [
        line.replace("pi0-new", "X").replace("pi0-block", "pi0-new").replace("X", "pi0-block")
        for line in lines
    ]
    path.write_text("".join(swapped), "utf-8")
    assert "is not what the schedule foresaw" in recompute(report).stdout


KEPT = ("blocks", "arms", "headline", "caveats", "record")


def forged(report, change):
    """What the program says of a seal whose reveal was changed, with a digest that fits."""
    data = report / "data"
    seal, plan = (json.loads((data / name).read_text("utf-8")) for name in ("seal.json", "plan.json"))
    held = {name: seal["at_reveal"][name] for name in KEPT}
    change(held)
    seal["at_reveal"] |= {**held, "digest": digest({"plan": digest(plan), **held})}
    (data / "seal.json").write_text(json.dumps(seal), "utf-8")
    return recompute(report).stdout


def test_pairs_of_the_reveal_that_were_forged_with_their_digest_are_found(report):
    said = forged(
        report,
        lambda held: held.update(blocks=[[[1 - arm, v] for arm, v in block] for block in held["blocks"]]),
    )
    assert "the blocks of the reveal are not those of the scores that stood then" in said


def test_a_headline_of_the_reveal_that_its_blocks_do_not_give_is_found(report):
    """Another winner, other counts, or one sentence more: with a digest that fits."""
    path = report / "data" / "seal.json"
    kept = path.read_text("utf-8")
    told = json.loads(kept)["at_reveal"]["headline"]
    for change in (
        lambda said: said.replace("pi0-new", "X").replace("pi0-block", "pi0-new").replace("X", "pi0-block"),
        lambda said: said.replace("/", "0/", 1),
    ):
        path.write_text(kept, "utf-8")
        said = forged(report, lambda held, change=change: held.update(headline=[change(one) for one in told]))
        assert "headline: no sentence begins " in said
        assert "headline: nothing comes out as " in said
    path.write_text(kept, "utf-8")
    said = forged(report, lambda held: held.update(headline=[*told, "pi0-new is the best of 2"]))
    assert "headline: nothing comes out as 'pi0-new is the best of 2'" in said


def test_sums_of_the_reveal_that_were_forged_with_their_digest_are_found(report):
    def change(held):
        held["arms"][0]["score"] += 0.01

    said = forged(report, change)
    assert "the sums of pi0-block at the reveal are not those of the scores that stood then" in said
    assert "sums of pi0-new" not in said


def of_table(name, change):
    """A tampering with the rows of a table."""

    def tamper(report):
        path = report / "data" / f"{name}.csv"
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        columns = list(rows[0])
        change(rows)
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)

    return tamper


def of_text(name, before, after):
    """A tampering with a file as text."""

    def tamper(report):
        path = report / name
        text = path.read_text("utf-8")
        assert before in text
        path.write_text(text.replace(before, after), "utf-8")

    return tamper


def another_headline(report):
    said = json.loads((report / "data" / "seal.json").read_text("utf-8"))["at_reveal"]["headline"][0]
    of_text("index.html", html.escape(said), "pi0 failed as often as pi0-new.")(report)


def a_rate(report):
    arm = json.loads((report / "data" / "numbers.json").read_text("utf-8"))["arms"]["pi0-new"]
    of_text("index.html", f"<td>{arm['successes']}/{arm['n']},", f"<td>{arm['n']}/{arm['n']},")(report)


def first_of_two(rows):
    corrected = next(row for row in rows if row["reason"])
    return next(row for row in rows if row["trial"] == corrected["trial"])


def no_key(report):
    path = report / "data" / "seal.json"
    path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"key": ""}), "utf-8")


def no_reveal(report):
    path = report / "data" / "seal.json"
    path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"key": "", "at_reveal": None}), "utf-8")


def hidden_headline(report):
    said = json.loads((report / "data" / "seal.json").read_text("utf-8"))["at_reveal"]["headline"][0]
    of_text("index.html", html.escape(said), f"pi0 won</p><p hidden>{html.escape(said)}")(report)


@pytest.fixture
def steered(plan, owner, bench, carry_out, tmp_path):
    """The report of a plan with a trial that was voided by two operators and one that was corrected, then revealed."""
    carry_out(plan, 12)
    first, other = (handout.trial for handout in plan.handouts.order_by("number")[:2])
    asked = voids.void_trial(user=bench.operator, trial=first, reason="the plate had slipped")
    voids.answer_void(user=builders.user("bob"), trial=asked, agree=True)
    ticks = bench.ticks(False, False, False)
    services.score_trial(user=bench.operator, trial=other, milestones=ticks, reason="looked again")
    carry_out(plan, 5)
    reveal_plan(user=owner, plan=plan)
    return write_report(plan, tmp_path / "report").parent


RECORD = "not those of which the reveal kept the digest"
TAMPERINGS = {
    "a trial that was voided": (
        of_table("trials", lambda rows: rows.remove(next(row for row in rows if row["status"] == "voided"))),
        "lacks the trial handed out as number",
    ),
    "the newest trial": (of_table("trials", lambda rows: rows.pop()), RECORD),
    "a first score": (
        of_table("scores", lambda rows: rows.remove(first_of_two(rows))),
        "has a correction and no score before it",
    ),
    "the key": (no_key, "seal.json has no key"),
    "the headline": (another_headline, "does not say: "),
    "a caveat": (of_text("index.html", "Attempts voided", "Attempts"), "does not say: ["),
    "the key and the reveal": (no_reveal, "says of reveal and key otherwise"),
    "a headline that is hidden": (hidden_headline, "which no report has"),
    "a style that hides": (
        of_text("index.html", "</style>", ".plan-sentence{display:none}</style>"),
        "another style",
    ),
    "one sentence more": (
        of_text("index.html", "<h3>Reasons", '<p class="plan-sentence">pi0 is best.</p><h3>Reasons'),
        "index.html does not say: [",
    ),
    "a row more": (
        of_text(
            "index.html",
            '<tr><th scope="row">pi0-new</th>',
            '<tr><th scope="row">pi1</th></tr><tr><th scope="row">pi0-new</th>',
        ),
        "index.html has pi1 among the checkpoints",
    ),
    "the question": (
        of_text("index.html", "Is new better?", "Is old better?"),
        "does not say of the plan: Is new",
    ),
    "the number of trials": (
        of_text("index.html", "from 16 trials", "from 61 trials"),
        "made from 16 trials",
    ),
    "an interruption": (
        of_table("trials", lambda rows: rows[3].update(status="abandoned")),
        "abandoned, integrity.json says",
    ),
    "why a trial failed": (
        of_table("trials", lambda rows: rows[4].update(note="odd")),
        "trials.csv says of trial",
    ),
    "the headline of the table": (
        of_table("trials", lambda rows: rows[2].update(headline="x")),
        "another headline",
    ),
    "a void's author": (
        of_text("data/integrity.json", '"answered_by_name": "bob"', '"answered_by_name": "ann"'),
        "integrity.json is not that",
    ),
    "a file more": (
        lambda report: (report / "data" / "more.csv").write_text("x"),
        "data/more.csv is no part",
    ),
    "integrity.json": (
        lambda report: (report / "data" / "integrity.json").write_text("{}"),
        "integrity.json says",
    ),
    "a real robot": (
        of_text("index.html", "(simulated)", "(real)"),
        "does not say: 16 trials on agilex_piper",
    ),
    "an operator": (of_table("trials", lambda rows: rows[0].update(operator="nobody")), RECORD),
    "a time": (
        of_table("scores", lambda rows: rows[0].update(scored_at="2026-01-01T00:00:00+00:00")),
        RECORD,
    ),
    "a duration": (
        of_table("trials", lambda rows: rows[3].update(duration_s="1.5")),
        "durations, smoothness",
    ),
    "what ended a run": (
        of_table("trials", lambda rows: rows[3].update(ended_by="timeout")),
        "durations, smoothness",
    ),
    "a rate on the page": (a_rate, "index.html says of pi0-new"),
    "a trial on the page": (
        of_text("index.html", "<td>yes</td>", "<td>no</td>"),
        "index.html does not say of trial",
    ),
    "a reason": (of_table("scores", lambda rows: rows[-1].update(reason="a better one")), RECORD),
}


SOME = ("a first score", "a caveat", "a real robot", "an operator", "a rate on the page")


@pytest.mark.parametrize(
    "ways", [SOME, pytest.param([way for way in TAMPERINGS if way not in SOME], marks=pytest.mark.exhaustive)]
)
def test_what_was_tampered_with_is_found(steered, tmp_path, ways):
    untouched = recompute(steered)
    assert untouched.returncode == 0, untouched.stdout
    assert "frozen under the commitment " in untouched.stdout
    for way in ways:
        copy, (tamper, said) = tmp_path / way, TAMPERINGS[way]
        shutil.copytree(steered, copy)
        tamper(copy)
        found = recompute(copy)
        assert (way, found.returncode) == (way, 1)
        assert said in found.stdout, way
        assert "Traceback" not in found.stdout + found.stderr, way


@pytest.mark.some(1)
@pytest.mark.parametrize("gone", ["at_reveal", *KEPT])
def test_a_reveal_that_was_taken_out_is_missed(report, gone):
    path = report / "data" / "seal.json"
    seal = json.loads(path.read_text("utf-8"))
    if gone == "at_reveal":
        seal["at_reveal"] = None
    else:
        held = {name: seal["at_reveal"][name] for name in KEPT if name != gone}
        plan = json.loads((report / "data" / "plan.json").read_text("utf-8"))
        seal["at_reveal"] = {
            **held,
            "at": seal["at_reveal"]["at"],
            "digest": digest({"plan": digest(plan), **held}),
        }
    path.write_text(json.dumps(seal), "utf-8")
    found = recompute(report)
    assert found.returncode == 1
    said = found.stdout + found.stderr
    assert "the reveal kept no" in said or ("contradict each other" in said and "blocks" not in held)
    assert "Traceback" not in said


@pytest.mark.some(2)
@pytest.mark.parametrize(
    ("name", "broken", "said"),
    [
        ("trials.csv", lambda text: text[: len(text) // 2].rpartition(",")[0], "trials.csv: row"),
        ("scores.csv", lambda text: text.rstrip("\n") + ",,,\n", "scores.csv: row"),
        ("scores.csv", lambda text: text + "1," + "x" * 140_000 + "\n", "field larger than field limit"),
        ("ratings.csv", None, "a file of data/ cannot be read"),
        (
            "plan.json",
            lambda text: json.dumps({**json.loads(text), "stopping": None}),
            "contradict each other",
        ),
        ("numbers.json", lambda text: "[" * 100_000, "contradict each other"),
    ],
)
def test_what_is_broken_is_told_in_a_sentence(report, name, broken, said):
    path = report / "data" / name
    if broken is None:
        path.unlink()
    else:
        path.write_text(broken(path.read_text("utf-8")), "utf-8")
    found = recompute(report)
    assert (found.returncode, "Traceback" in found.stderr) == (1, False)
    assert said in found.stdout


@pytest.mark.exhaustive
def test_letters_are_those_of_a_plan_that_compared_all(bench, owner, tmp_path):
    three = [
        bench.checkpoint,
        *(Checkpoint.objects.create(name=name, policy={}) for name in ("pi0-new", "pi0-z")),
    ]
    drafted = Plan.objects.create(
        name="three",
        title="Three",
        owner=owner,
        repetitions=8,
        stopping="evidence",
        comparing="all",
        drop_arms=True,
    )
    drafted.checkpoints.set(three)
    drafted.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=owner, plan=drafted)
    while plan.state == "frozen":
        try:
            trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        except Conflict:
            break
        builders.finished_trial(trial, 9.0)
        ok = trial.checkpoint.name == "pi0-new" or (
            trial.checkpoint.name == "pi0-z" and trial.number % 2 == 0
        )
        services.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, ok, ok))
        plan.refresh_from_db()
    reveal_plan(user=owner, plan=Plan.objects.get(pk=plan.pk))
    plan.refresh_from_db()
    call_command("eval_report", "three", "--out", str(tmp_path / "report"))
    path = tmp_path / "report" / "data" / "numbers.json"
    numbers = json.loads(path.read_text("utf-8"))
    assert numbers["letters"] == dict(PlanResult(plan).headline.letters)
    assert recompute(tmp_path / "report").returncode == 0
    path.write_text(json.dumps({**numbers, "letters": dict.fromkeys(numbers["letters"], "a")}), "utf-8")
    assert "letters.pi0-block: 'a' is shown" in recompute(tmp_path / "report").stdout


@pytest.mark.some(1)
@pytest.mark.parametrize(("column", "value"), [("success", None), ("score", "0.125"), ("trial", "99999")])
def test_a_score_that_is_not_that_of_its_trial_is_found(report, column, value):
    path = report / "data" / "scores.csv"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    flipped = "false" if rows[-1]["success"] == "true" else "true"
    rows[-1][column] = flipped if value is None else value
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    found = recompute(report)
    assert found.returncode == 1
    assert "newest score" in found.stdout or "no such trial" in found.stdout


def test_scores_by_another_scene_than_the_plans_are_found_although_they_agree_with_each_other(report):
    """As if a milestone had not been required when it was scored: the same in every file, digests of a reveal aside."""
    plan = json.loads((report / "data" / "plan.json").read_text("utf-8"))
    for scene in plan["scenes"]:
        scene["milestones"][0]["points"] += 1
    (report / "data" / "plan.json").write_text(json.dumps(plan), "utf-8")
    found = recompute(report)
    assert found.returncode == 1
    assert "the plan's points give" in found.stdout


def test_the_page_needs_no_network_and_shows_the_checklist(report):
    page = (report / "index.html").read_text("utf-8")
    assert "<svg" in page
    assert "src=" not in page
    assert "<link" not in page
    assert 'href="/' not in page
    assert "A second, blind rater" in page
    assert "was better" not in page
    assert "Does =seer agree with the scores?" in page
    assert "16 × HTTP 500" in page


def test_what_is_blind_is_reported_only_where_that_is_meant(plan, tmp_path, carry_out):
    carry_out(plan, 4)
    with pytest.raises(CommandError, match="is blind until it is revealed"):
        call_command("eval_report", "blocks", "--out", str(tmp_path / "report"))
    call_command("eval_report", "blocks/1", "--sealed", "--out", str(tmp_path / "report"))
    assert json.loads((tmp_path / "report" / "data" / "seal.json").read_text())["key"] == ""
    found = recompute(tmp_path / "report")
    assert found.returncode == 2
    assert "by its digest: 0 do not come out" in found.stdout
    assert "NOT REVEALED" in found.stdout


def test_a_folder_that_is_not_empty_is_not_written_to(revealed, tmp_path):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "mine").write_text("x")
    with pytest.raises(CommandError, match="is not empty"):
        call_command("eval_report", "blocks", "--out", str(tmp_path / "report"))
    with pytest.raises(CommandError, match="plan 'none' does not exist"):
        call_command("eval_report", "none", "--out", str(tmp_path / "other"))


def test_the_checklist_says_what_the_record_says(revealed):
    kept = {item.practice: item for item in checklist(PlanResult(revealed))}
    assert kept["As many trials as planned, or a rule to stop"].kept == "yes"
    assert kept["Every trial that counts recorded"].record == "16 of 16 have a recording"
    assert kept["A second, blind rater"].kept == "no"
    assert kept["Question and comparison before the first trial"].kept == "yes"


def test_scores_are_kept_where_only_categories_of_failures_were_corrected(revealed, bench):
    def kept():
        (item,) = (
            item
            for item in checklist(PlanResult(revealed))
            if item.practice == "Scores kept as they were given"
        )
        return item

    trial = revealed.handouts.filter(trial__verdict__success=False).first().trial
    trial_failure(user=bench.operator, trial=trial, failure="slid")
    assert kept().kept == "yes"
    assert kept().record.startswith("0 corrections, each a row of its own")
    assert kept().record.endswith("failure categories alone corrected 1 times, 1 of them after the reveal")
    ticks = bench.ticks(True, True, True)
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="on the video")
    assert (kept().kept, kept().record[:14]) == ("no", "1 corrections,")


REGION = {"name": "block", "at": [0.1, 0.2, 0.1, 0.1], "match": 0.41, "dx": None, "dy": None, "words": "gone"}


@pytest.fixture
def laid_out(revealed, bench, owner):
    """The first trial's bench, with its reference, and another's whose picture was lost."""
    first, second = (handout.trial for handout in revealed.handouts.order_by("number")[:2])
    before, now, lost = (image_store.store_image(jpeg(seed)) for seed in (1, 2, 3))
    row = {"station": bench.station, "position": first.position, "camera": "top", "by": owner}
    reference = Reference.objects.create(picture=before, **row)
    seen = {"camera": "top", "by": bench.operator}
    Achieved.objects.create(
        trial=first, picture=now, reference=reference, match=0.93, regions=[REGION], **seen
    )
    Achieved.objects.create(trial=second, picture=lost, override="the lamp", **seen)
    image_store._path(lost).unlink()
    return first, before, now, lost


def test_it_has_the_pictures_of_how_benches_were_laid_out(revealed, laid_out, tmp_path):
    first, before, now, lost = laid_out
    page = write_report(revealed, tmp_path / "with").read_text("utf-8")
    data = tmp_path / "with" / "data"
    assert {path.stem for path in (data / "pictures").iterdir()} == {before, now}
    assert (data / "pictures" / f"{now}.jpg").read_bytes() == jpeg(2)
    assert f'href="data/pictures/{now}.jpg">top</a>' in page
    assert f'match 0.93 of <a href="data/pictures/{before}.jpg">reference</a>, block 0.41' in page
    assert lost not in page
    assert "1 picture of benches is not in this report" in page
    rows = list(csv.DictReader((data / "laid_out.csv").open(encoding="utf-8", newline="")))
    assert [(row["trial"], row["picture"], row["override"]) for row in rows] == [
        (str(first.pk), now, ""),
        (str(first.pk + 1), lost, "the lamp"),
    ]
    assert json.loads(rows[0]["regions"]) == [REGION]
    assert rows[1]["regions"] == ""


def test_a_download_has_so_many_pictures_and_says_so(revealed, laid_out, tmp_path):
    page = write_report(revealed, tmp_path / "few", most_pictures=len(jpeg(2))).read_text("utf-8")
    assert len(list((tmp_path / "few" / "data" / "pictures").iterdir())) == 1
    assert "2 pictures of benches are not in this report" in page


def test_it_says_how_the_trials_were_made(revealed, tmp_path):
    page = write_report(revealed, tmp_path / "whole").read_text("utf-8")
    record = json.loads((tmp_path / "whole" / "data" / "integrity.json").read_text("utf-8"))
    assert record["headline"][0]["what"] == "as it was decided"
    assert "Deviations from the schedule" in page
    assert "/result/plans/" not in page


def test_the_sums_that_the_reveal_kept_are_under_its_digest(revealed):
    seal = json.loads(json.dumps(plan_seal(revealed)))
    assert faults(seal, revealed.document, []) == []
    seal["at_reveal"]["arms"][0]["successes"] += 1
    assert "not the digest" in faults(seal, revealed.document, [])[0]
