"""Nothing is lost between the gate, the stories and the labs."""

import re
from pathlib import Path

from _pytest.mark.expression import Expression

MAKEFILE = Path(__file__).parents[1] / "Makefile"


def selections(target):
    """What the calls of pytest that a target of the Makefile makes are asked for."""
    lines = re.search(rf"^{target}: .*\n((?:\t.*\n|ifdef.*\n|else\n|endif\n)+)", MAKEFILE.read_text(), re.M)[
        1
    ]
    return [asked for line in lines.splitlines() for asked in re.findall(r'-m "([^"]+)"', line)]


def test_every_test_is_made_by_just_one_of_the_three_commands():
    asked = [*selections("test"), *selections("labs")]
    assert asked[1:3] == ["story", "lab"]  # tests/conftest.py knows them
    for marks in (
        {"story"},
        {"lab"},
        {"exhaustive"},
        set(),
    ):  # properties are made twice, with other examples
        takes = [one for one in asked if Expression.compile(one).evaluate(lambda name, **_: name in marks)]  # noqa: B023
        assert len(takes) == 1, (marks, takes)
