from __future__ import annotations

from pathlib import Path

import pytest

from runtime.datasets.__main__ import main
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


def test_recover_removes_what_was_left_and_checks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["publish", str(record(tmp_path / "episodes", frames=4)), "--to", str(tmp_path / "set")])
    (tmp_path / "set/.publishing").mkdir()
    assert main(["recover", str(tmp_path / "set")]) == 0
    assert not (tmp_path / "set/.publishing").exists()
    assert main(["recover", str(tmp_path / "absent")]) == 1
    assert "no dataset folder" in capsys.readouterr().err
