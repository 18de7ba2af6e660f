import pytest

from tests.lint.subjects import LONGEST, subject_problem


@pytest.mark.parametrize(
    "subject",
    [
        "fix(control): hold the gripper while a lock changes",
        "refactor: move the simulation",
        "feat(policies)!: rename `observe`",
        "docs(changelog): 0.2.0",
        "style: " + "x" * (LONGEST - len("style: ")),
    ],
)
def test_a_conventional_subject_is_allowed(subject: str) -> None:
    assert subject_problem(subject) == ""


@pytest.mark.parametrize(
    ("subject", "why"),
    [
        ("Formatted", "allowed: TYPE"),
        ("fix(Control): hold", "allowed: TYPE"),
        ("fix: Hold the gripper", "in lower case"),
        ("fix: hold the gripper.", "without a period"),
        ("fix:hold", "allowed: TYPE"),
        ("style: " + "x" * LONGEST, "79 characters; allowed: 72"),
    ],
)
def test_any_other_subject_is_refused_with_what_is_allowed(subject: str, why: str) -> None:
    assert why in subject_problem(subject)
