"""A dataset's card: facts of its files, and nobody's name."""

from __future__ import annotations

import json
from pathlib import Path

from runtime.datasets.card import render_card
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.datasets.small import record


def front_matter(card: str) -> dict[str, object]:
    """The YAML of a card, whose values are JSON."""
    dashes, head, _ = card.split("---\n", 2)
    assert dashes == ""
    return {key: json.loads(value) for key, _, value in (line.partition(": ") for line in head.splitlines())}


def test_our_own_dataset_says_what_it_contains_and_how_it_was_collected(tmp_path: Path) -> None:
    dataset = tmp_path / "cups"
    for index, (kind, success) in enumerate([("rollout", True), ("rollout", False), ("demonstration", True)]):
        episode = record(
            tmp_path / "episodes",
            frames=30,
            kind=kind,
            task="stack | the <cups>\nnow",
            operator="olga-secret",
            checkpoint={"id": index, "name": "pi0-secret"},
        )
        publish(episode, dataset, success=success)
    card = render_card(open_dataset(dataset), "cups", "cc-by-4.0")
    head = front_matter(card)
    assert (head["license"], head["task_categories"]) == ("cc-by-4.0", ["robotics"])
    assert head["tags"] == ["LeRobot", "robotics", "small"]
    assert "3 episodes of small: 90 rows at 30 Hz, 0 min 3 s, in the format of LeRobot v2.1." in card
    assert "| stack \\| the &lt;cups&gt; now | 3 |" in card
    assert "* 1 demonstrations: a person drove the robot\n* 2 rollouts: a policy drove the robot" in card
    assert "* 2 succeeded\n* 1 failed" in card
    assert "| observation.state | float32 |" in card
    assert "## Cameras" in card
    assert "olga-secret" not in card
    assert "pi0-secret" not in card


def test_of_another_programs_dataset_it_says_what_is_unknown(tmp_path: Path) -> None:
    write(tmp_path / "cups", Plan("v3.0", lengths=(4, 6)))
    card = render_card(open_dataset(tmp_path / "cups"), "cups")
    assert "license" not in front_matter(card)
    assert "* 2 of which the files do not say how" in card
    assert "* 2 not scored" in card
    assert "No licence is granted: ask whoever owns the dataset." in card
