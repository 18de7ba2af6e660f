"""Which state of the source runs: found in a real checkout, and nothing where there is none."""

import os
import shutil
import subprocess

import pytest

from runtime.core import git_revision as module
from runtime.core.git_revision import revision, revision_of

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="there is no git command")


def git(folder, *arguments):
    named = ("-c", "user.name=ann", "-c", "user.email=ann@localhost")
    plain = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    done = subprocess.run(
        ("git", *named, "-C", str(folder), *arguments), capture_output=True, text=True, check=True, env=plain
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "runtime").mkdir()
    (tmp_path / "runtime" / "tick.py").write_text("x = 1\n")
    (tmp_path / "notes.md").write_text("one\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    return tmp_path


def test_a_clean_checkout_is_its_commit(checkout):
    assert revision_of(checkout) == {"commit": git(checkout, "rev-parse", "HEAD"), "dirty": False}


@pytest.mark.parametrize(
    ("name", "dirty"),
    [
        ("runtime/tick.py", True),
        ("notes.md", True),
        ("runtime/new.py", True),
        ("run.log", False),
    ],
)
def test_a_changed_file_or_a_new_one_among_the_code_makes_it_dirty(checkout, name, dirty):
    (checkout / name).write_text("changed\n")
    assert revision_of(checkout)["dirty"] is dirty


def test_nothing_is_said_where_there_is_no_checkout(tmp_path):
    assert revision_of(tmp_path) == {}


def test_nothing_is_said_of_a_folder_within_somebody_elses_checkout(checkout):
    assert revision_of(checkout / "runtime") == {}


def test_nothing_is_said_where_there_is_no_commit_yet(tmp_path):
    git(tmp_path, "init", "-q")
    assert revision_of(tmp_path) == {}


def test_nothing_is_said_without_git(checkout, monkeypatch, tmp_path_factory):
    monkeypatch.setenv("PATH", str(tmp_path_factory.mktemp("empty")))
    assert revision_of(checkout) == {}


def test_variables_of_a_hook_lead_nowhere_else(checkout, monkeypatch, tmp_path_factory):
    monkeypatch.setenv("GIT_DIR", str(tmp_path_factory.mktemp("other")))
    assert revision_of(checkout)["dirty"] is False


def test_our_own_is_asked_for_once(monkeypatch):
    asked = []
    monkeypatch.setattr(
        module, "revision_of", lambda root: asked.append(root) or {"commit": "c", "dirty": False}
    )
    revision.cache_clear()
    try:
        assert revision() is revision()
        assert dict(revision()) == {"commit": "c", "dirty": False}
    finally:
        revision.cache_clear()
    (root,) = asked
    assert (root / "runtime" / "core" / "git_revision.py").is_file()
