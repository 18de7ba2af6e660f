"""Checks the vocabulary of names: `python -m tests.vocabulary --check`, called by `make lint`."""

from __future__ import annotations

import sys

from tests.vocabulary.names import ALLOWED, avoided_names, problems


def main(arguments: list[str]) -> int:
    """With --check print names with avoided words, 1 if there are any; with --write list those that there are."""
    if arguments == ["--write"]:
        ALLOWED.write_text("".join(f"{name}\n" for name in sorted(avoided_names())), "utf-8")
        return 0
    if arguments != ["--check"]:
        print("allowed: --check, or --write for a new list after names have gone", file=sys.stderr)
        return 2
    wrong = list(problems(avoided_names(), set(ALLOWED.read_text("utf-8").splitlines())))
    print("\n".join(wrong) or "no new name has a word that is avoided")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
