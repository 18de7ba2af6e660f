"""Checks the subjects of commits: `python -m tests.lint.subjects`, called by `make lint`.

Conventional Commits, `type(scope): subject`, from the commit that added this file on; earlier subjects are free.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__)
TYPES = ("feat", "fix", "refactor", "perf", "docs", "test", "build", "ci", "chore", "style")
LONGEST = 72
_FORM = re.compile(rf"({'|'.join(TYPES)})(\([a-z0-9_/,-]+\))?!?: [^\sA-Z].*[^.]")


def subject_problem(subject: str) -> str:
    """Return what is wrong with the subject of a commit, "" if nothing is."""
    if len(subject) > LONGEST:
        return f"{len(subject)} characters; allowed: {LONGEST}"
    if not _FORM.fullmatch(subject):
        return f"allowed: TYPE(SCOPE): subject in lower case, without a period; TYPE is {', '.join(TYPES)}"
    return ""


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(HERE.parent), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> int:
    """Print the commits with a wrong subject; 1 if there are any."""
    try:
        added = _git("log", "--format=%H", "--diff-filter=A", "--", str(HERE)).split()
    except (OSError, subprocess.CalledProcessError):
        added = []
    if not added:
        print("subjects of commits: not checked, because there is no history here")
        return 0
    rows = _git("log", "--no-merges", "--format=%h %s", f"{added[-1]}..HEAD").splitlines()
    commits = [row.partition(" ")[::2] for row in rows]
    wrong = [
        f"{commit} {subject!r}: {why}" for commit, subject in commits if (why := subject_problem(subject))
    ]
    print("\n".join(wrong) or "every subject of a commit has its form")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
