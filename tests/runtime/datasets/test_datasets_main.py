from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.__main__ import MOST, episodes, main
from tests.runtime.datasets.small import record


def test_publish_says_where_the_episode_went(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = record(tmp_path / "episodes", frames=4)
    assert main(["publish", str(episode), "--to", str(tmp_path / "set")]) == 0
    assert "published: " in capsys.readouterr().out
    assert main(["publish", str(episode), "--to", str(tmp_path / "set")]) == 0
    assert "published anew: " in capsys.readouterr().out
    assert main(["check", str(tmp_path / "set")]) == 0
    assert "is whole" in capsys.readouterr().out


def test_a_refusal_goes_to_the_error_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = record(tmp_path / "episodes", frames=4, status="interrupted")
    assert main(["publish", str(episode), "--to", str(tmp_path / "set")]) == 1
    assert "--include-interrupted" in capsys.readouterr().err
    assert main(["publish", str(episode), "--to", str(tmp_path / "set"), "--include-interrupted"]) == 0


def test_success_and_failure_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        main(["publish", "x", "--to", "y", "--success", "--failure"])


def test_a_check_lists_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(
        ["publish", str(record(tmp_path / "episodes", frames=4)), "--to", str(tmp_path / "set"), "--failure"]
    )
    (tmp_path / "set/data/chunk-000/episode_000000.parquet").unlink()
    assert main(["check", str(tmp_path / "set")]) == 1
    assert "episode 0" in capsys.readouterr().out


def test_a_folder_without_an_episode_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["publish", str(tmp_path / "absent"), "--to", str(tmp_path / "set")]) == 1
    assert "manifest.json" in capsys.readouterr().err


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the program; its result, what it says, and what it complains of."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return run


def test_a_dataset_goes_from_version_to_version_and_is_taken_apart_and_together(
    tmp_path: Path, run: Run
) -> None:
    for seed in range(3):
        episode = record(tmp_path / "episodes", frames=4 + seed, seed=seed)
        assert run("publish", episode, "--to", tmp_path / "set", "--version", "v3.0")[0] == 0
    new, parts = tmp_path / "new", tmp_path / "parts"
    code, said, _ = run("convert", tmp_path / "set", "--to", new, "--version", "v2.1")
    assert (code, said) == (0, f"written: {new}, v2.1, 3 episodes, 15 frames\n")
    code, said, _ = run("split", new, "train=0:2", "test=2", "--to", parts)
    assert said.splitlines() == [
        f"written: {parts / 'train'}, v2.1, 2 episodes, 9 frames",
        f"written: {parts / 'test'}, v2.1, 1 episodes, 6 frames",
    ]
    both = tmp_path / "both"
    code, said, _ = run("merge", parts / "test", parts / "train", "--to", both, "--version", "v3.0")
    assert (code, said) == (0, f"written: {both}, v3.0, 3 episodes, 15 frames\n")
    code, said, _ = run("delete", both, "0,2")
    assert (code, said) == (0, f"written: {both}, v3.0, 1 episodes, 4 frames\n")
    code, said, _ = run("repair", both)
    assert (code, said.splitlines()) == (
        0,
        [
            f"{both} is whole",
            "inputs of a policy: observation.state, observation.images.cam_high, observation.images.cam_wrist",
            "outputs of a policy: action",
        ],
    )


def test_what_was_left_out_is_told(tmp_path: Path, run: Run) -> None:
    run("publish", record(tmp_path / "episodes", frames=4), "--to", tmp_path / "set")
    (tmp_path / "set/notes").mkdir()
    _, said, _ = run("convert", tmp_path / "set", "--to", tmp_path / "new", "--version", "v3.0")
    assert f"left out: {tmp_path / 'set/notes'}" in said


@pytest.mark.some(6)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("convert", "SET", "--to", "NEW", "--version", "v3.0", "--rename", "action"), "expected OLD=NEW"),
        (("split", "SET", "../train=0", "--to", "NEW"), "expected NAME=EPISODES"),
        (("split", "SET", "a=0", "a=1", "--to", "NEW"), "expected NAME=EPISODES"),
        (("split", "SET", "a=", "--to", "NEW"), "names no episodes"),
        (("delete", "SET", "2:1"), "names no episodes"),
        (("delete", "SET", "-"), "names no episodes"),
        (("delete", "SET", "0"), "would have no episode"),
        (("delete", "ABSENT", "0"), "there is no dataset folder"),
        (("merge", "SET", "SET", "--to", "NEW"), "there twice"),
        (("check", "ABSENT"), "does not exist"),
    ],
)
def test_what_cannot_be_done_is_said(
    tmp_path: Path, run: Run, arguments: tuple[str, ...], named: str
) -> None:
    run("publish", record(tmp_path / "episodes", frames=4), "--to", tmp_path / "set")
    places = {"SET": tmp_path / "set", "NEW": tmp_path / "new", "ABSENT": tmp_path / "absent"}
    code, said, complained = run(*(places.get(argument, argument) for argument in arguments))
    assert code == 1
    assert named in said + complained
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("text", "found"), [("3", [3]), ("0:3", [0, 1, 2]), ("0:2,7,4:5", [0, 1, 7, 4])])
def test_episodes_are_named_by_index_and_range(text: str, found: list[int]) -> None:
    assert episodes(text) == found


@pytest.mark.parametrize("text", ["0:999999999", f"0:{MOST},5", "0:9" + "9" * 5000, "9" * 5000])
def test_more_episodes_than_anybody_means_are_not_counted_out(text):
    with pytest.raises(RecordingError, match=r"too many episodes|names no episodes"):
        episodes(text)


def test_recover_removes_what_was_left_and_checks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["publish", str(record(tmp_path / "episodes", frames=4)), "--to", str(tmp_path / "set")])
    (tmp_path / "set/.publishing").mkdir()
    assert main(["recover", str(tmp_path / "set")]) == 0
    assert not (tmp_path / "set/.publishing").exists()
    assert main(["recover", str(tmp_path / "absent")]) == 1
    assert "no dataset folder" in capsys.readouterr().err
