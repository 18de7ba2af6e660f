from __future__ import annotations

import sys

import pytest

from benchmarks import __main__ as command_line
from benchmarks.chaos import Act, DataAtEnd, counted

ACTS = [Act("prepare", 1), Act("run", 1, "r1", "e1"), Act("score", 1, "s1")]


def kept(**other: object) -> DataAtEnd:
    facts = {"trials": {1: "scored"}, "scores": [(1, "s1")], "rows": {"e1"}, "folders": {"e1"}}
    return DataAtEnd(**{**facts, "trial_episodes": ["e1"], **other})  # type: ignore[arg-type]


def wrong(found: DataAtEnd) -> set[str]:
    return {name for name, things in counted(ACTS, found).items() if things}


def test_nothing_is_wrong_where_all_that_was_acknowledged_is_there() -> None:
    assert wrong(kept()) == set()


@pytest.mark.parametrize(
    ("found", "name"),
    [
        ({"rows": set(), "at_home": {"e1"}}, "lost_episodes"),
        ({"scores": []}, "lost_scores"),
        ({"trials": {}}, "lost_trials"),
        ({"scores": [(1, "s1"), (1, "s2")]}, "doubled"),
        ({"trials": {1: "scored", 2: "voided"}}, "doubled"),
        ({"trial_episodes": ["e1", "e1"]}, "doubled"),
        ({"trials": {1: "running"}}, "stuck_trials"),
        ({"refusing": ["bench-1"]}, "stuck_trials"),
    ],
)
def test_each_thing_that_is_wrong_is_counted_under_its_name(found: dict[str, object], name: str) -> None:
    assert wrong(kept(**found)) == {name}


def test_an_episode_that_is_nowhere_is_lost_after_it_was_deleted_at_home_too() -> None:
    assert wrong(kept(folders=set())) == {"lost_episodes", "lost_after_delete"}


def test_a_run_that_is_said_never_to_have_begun_has_no_episode_to_lose() -> None:
    assert wrong(kept(folders=set(), rows=set(), unopened={"r1"})) == set()


def test_a_seed_is_for_chaos_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", "ik", "--seed", "1"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert "--seed is for chaos" in capsys.readouterr().err
