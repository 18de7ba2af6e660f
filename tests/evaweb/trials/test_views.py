import re

import pytest
from django.test import Client

from evaweb.episodes.models import Episode
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint, Score, Trial
from tests.evaweb.trials import builders


@pytest.fixture
def browser(bench):
    made = Client()
    made.force_login(bench.operator)
    return made


def page(browser, path, status=200, **query):
    answer = browser.get(path, query)
    assert answer.status_code == status
    return answer.content.decode()


def send(bench, trial, *reached, **given):
    ids = [str(key) for key, done in bench.ticks(*reached).items() if done]
    return {"milestone": ids, **given}


def test_an_empty_lab_says_what_would_be_here_and_how_to_get_it(browser):
    text = page(browser, "/result/")
    assert "No trials yet" in text
    assert "Go to the stations" in text


def test_nobody_sees_results_without_logging_in(bench):
    assert Client().get("/result/").status_code == 302
    assert Client().post("/result/trials/1/score").status_code == 302


def test_every_rate_stands_beside_its_n_and_its_interval(bench, browser):
    for success in (True, True, True, False):
        bench.scored(success)
    voids.void_trial(user=bench.operator, trial=bench.scored(), reason="a hand")
    text = page(browser, "/result/")
    row = re.search(r'<tr data-checkpoint="pi0-block">.*?</tr>', text, re.S).group()
    cells = re.findall(r'<td class="number[^"]*">(?:<a[^>]*>)?([^<]*)', row)
    assert cells == ["3", "4", "75 %", "30 to 95 %", "81 %", "12.5 s", "–"]
    assert 'aria-label="75 % of 4, 95 % interval 30 to 95"' in row
    assert "1 voided" in row
    assert "no ranking" in text


def test_smoothness_is_missing_where_it_was_not_measured_and_says_of_how_many_it_is(bench, browser):
    for smooth in (-5.0, -6.0, None):
        trial = bench.scored(True)
        if smooth is not None:
            Episode.objects.filter(trial=trial).update(status="finished", smoothness=smooth)
    assert "−5.50 [−11.85, 0.85], 2 of 3 trials" in page(browser, "/result/")


def test_a_cell_without_a_scored_trial_has_no_rate(bench, browser):
    bench.ended()
    text = page(browser, "/result/")
    assert "no scored trial" in text
    assert "1 to be scored" in text


def test_filters_are_in_the_address_and_htmx_gets_the_body_alone(bench, browser):
    other = Checkpoint.objects.create(name="act/step 5000")
    bench.scored()
    bench.scored(checkpoint=other)
    answer = browser.get("/result/", {"checkpoint": "act/step 5000"}, headers={"HX-Request": "true"})
    text = answer.content.decode()
    assert "<html" not in text
    assert text.count("<tr data-trial=") == 1
    voided = page(browser, "/result/?checkpoint=act/step+5000&status=voided")
    assert (voided.count("data-checkpoint="), voided.count("<tr data-trial=")) == (1, 0)


def test_a_filter_that_names_nothing_says_so_and_shows_everything(bench, browser):
    bench.scored()
    text = page(browser, "/result/", scene="nope", since="soon")
    assert "scene &#x27;nope&#x27; does not exist" in text
    assert text.count("<tr data-trial=") == 1


def test_many_trials_come_in_pages_with_a_bounded_number_of_queries(
    bench, browser, django_assert_max_num_queries
):
    for _ in range(53):
        bench.scored()
    with django_assert_max_num_queries(22):
        text = page(browser, "/result/")
    assert text.count("<tr data-trial=") == 50
    assert page(browser, "/result/", page=2).count("<tr data-trial=") == 3


def test_names_and_notes_are_text_and_never_markup(bench, browser):
    trial = bench.ended()
    ticks = bench.ticks(False, False, False)
    services.score_trial(
        user=bench.operator, trial=trial, milestones=ticks, note="<script>x</script>", failure="<b>"
    )
    for path in ("/result/", f"/result/trials/{trial.pk}/"):
        text = page(browser, path)
        assert "<script>x" not in text
        assert "&lt;script&gt;x&lt;/script&gt;" in text


def test_a_trial_shows_its_facts_scores_commands_and_attempts(bench, browser, wire):
    from evaweb.trials.station_commands import trial_command

    trial = bench.prepare()
    order = {"user": bench.operator, "page": "p", "epoch": 1, "boot": builders.BOOT, "sequence": 1}
    for kind in ("setup", "run"):
        trial_command(trial=trial, kind=kind, **order)
    Trial.objects.filter(pk=trial.pk).update(status="interrupted", reason="the e-stop was pressed")
    again = bench.prepare()
    assert again.attempt == 2
    text = page(browser, f"/result/trials/{trial.pk}/")
    for part in (
        "the e-stop was pressed",
        "put the block on the plate",
        str(trial.uuid),
        str(wire.episode),
        f"/replay/{wire.episode}/",
        f"/result/trials/{again.pk}/",
        "<td>setup</td>",
        "<td>run</td>",
    ):
        assert part in text


def test_its_videos_are_there_once_they_can_be_played(bench, browser, settings):
    trial = bench.scored()
    episode, uuid = trial.episode, trial.episode_id
    episode.status, episode.cameras, episode.frames = "finished", ["front", "left_wrist"], 90
    episode.control = {"missed": 0, "lateness_p99_ms": 0.123456}
    episode.save()
    assert "<video" not in page(browser, f"/result/trials/{trial.pk}/")
    (settings.DATA_DIR / "previews" / str(uuid)).mkdir(parents=True)
    text = page(browser, f"/result/trials/{trial.pk}/")
    assert text.count("<video") == 2
    assert f"/episodes/{uuid}/video/left_wrist" in text
    assert "<dt>Lateness, 99th percentile</dt><dd>0.123 ms</dd>" in text


def test_a_score_is_given_and_corrected_on_the_page(bench, browser):
    trial = bench.ended()
    where = f"/result/trials/{trial.pk}"
    answer = browser.post(
        f"{where}/score", send(bench, trial, True, True, False, note="fell", failure="slip")
    )
    assert answer.status_code == 302
    answer = browser.post(f"{where}/score", send(bench, trial, True, True, True, note="it lies on it"))
    assert answer.status_code == 400
    text = answer.content.decode()
    assert "give a reason" in text
    assert "it lies on it" in text
    assert len(re.findall(r'name="milestone" value="\d+" checked>', text)) == 3
    answer = browser.post(f"{where}/score", send(bench, trial, True, True, True, reason="seen on the video"))
    assert answer.status_code == 302
    assert list(Score.objects.values_list("success", flat=True)) == [False, True]
    text = page(browser, f"{where}/")
    assert "Correction: seen on the video" in text
    assert text.count("<li") >= 2


def test_a_correction_begins_with_what_was_said_of_the_failure_before(bench, browser):
    builders.failure_terms()
    trial = bench.ended()
    where = f"/result/trials/{trial.pk}"
    said = {"failure_phase": "grasp", "failure": "slipped on the way"}
    ticks = bench.ticks(True, False, False)
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, failure=said["failure"])
    text = page(browser, f"{where}/")
    assert "<dd>slipped on the way</dd>" in text
    assert 'name="failure" value="slipped on the way" checked' in text
    assert 'name="failure" value="retired"' not in text
    answer = browser.post(
        f"{where}/score", send(bench, trial, True, False, False, reason="on the video", **said)
    )
    assert answer.status_code == 302
    assert "<dd>grasp: slipped on the way</dd>" in page(browser, f"{where}/")


def test_a_form_that_is_sent_twice_is_one_score(bench, browser):
    trial = bench.ended()
    where = f"/result/trials/{trial.pk}"
    uuid = re.search(r'name="uuid" value="([0-9a-f-]{36})"', page(browser, f"{where}/"))[1]
    form = {**send(bench, trial, True, True, True, note="clean"), "uuid": uuid}
    for _ in range(2):
        assert browser.post(f"{where}/score", form).status_code == 302
    assert str(Score.objects.get().uuid) == uuid
    answer = browser.post(f"{where}/score", {**form, "note": "typed after going back", "reason": "x"})
    assert answer.status_code == 409
    assert f"uuid {uuid} is that of another score" in answer.content.decode()
    assert uuid not in re.findall(r'name="uuid" value="([0-9a-f-]{36})"', answer.content.decode())


def test_success_is_asked_for_where_no_milestone_is_required(bench, browser):
    bench.scene.milestones.update(required=False)
    trial = bench.ended()
    where = f"/result/trials/{trial.pk}/score"
    assert 'name="success"' in page(browser, f"/result/trials/{trial.pk}/")
    assert browser.post(where, send(bench, trial, True, True, True)).status_code == 400
    assert browser.post(where, send(bench, trial, True, True, True, success="no")).status_code == 302
    assert Score.objects.get().success is False


def test_a_trial_is_voided_with_a_reason_that_stays_typed(bench, browser):
    trial = bench.scored()
    where = f"/result/trials/{trial.pk}"
    answer = browser.post(f"{where}/void", {"void_reason": " "})
    assert answer.status_code == 400
    assert "reason is empty" in answer.content.decode()
    assert browser.post(f"{where}/void", {"void_reason": "the plate was missing"}).status_code == 302
    text = page(browser, f"{where}/")
    assert "Does not count: the plate was missing" in text
    assert '<form method="post" action="/result' not in text


def test_a_viewer_sees_no_forms_and_cannot_send_them(bench):
    trial = bench.scored()
    viewer = Client()
    viewer.force_login(builders.user("vic", "viewer"))
    where = f"/result/trials/{trial.pk}"
    assert "result-form" not in page(viewer, f"{where}/")
    assert viewer.post(f"{where}/score", send(bench, trial, True, True, True, reason="x")).status_code == 403
    assert viewer.post(f"{where}/void", {"void_reason": "x"}).status_code == 403
    assert Score.objects.count() == 1


def test_who_may_not_change_the_verdict_of_anothers_trial_is_told_before_they_type(bench, browser):
    trial = bench.scored()
    said = "another verdict cannot"
    assert said not in page(browser, f"/result/trials/{trial.pk}/")
    other = Client()
    other.force_login(builders.user("bob"))
    assert said in page(other, f"/result/trials/{trial.pk}/")


def test_a_running_trial_cannot_be_scored_on_the_page(bench, browser):
    trial = bench.prepare()
    Trial.objects.update(status="running")
    where = f"/result/trials/{trial.pk}"
    assert "result-form" not in page(browser, f"{where}/")
    assert browser.post(f"{where}/score", send(bench, trial, True, True, True)).status_code == 409


@pytest.mark.parametrize("id", [0, 999999, 2**70])
def test_guessed_trials_are_not_found(browser, id):
    assert browser.get(f"/result/trials/{id}/").status_code == 404
    assert browser.post(f"/result/trials/{id}/score").status_code == 404


def test_forms_need_their_csrf_token(bench):
    browser = Client(enforce_csrf_checks=True)
    browser.force_login(bench.operator)
    trial = bench.scored()
    assert browser.post(f"/result/trials/{trial.pk}/void", {"void_reason": "x"}).status_code == 403
    trial.refresh_from_db()
    assert trial.status == "scored"
