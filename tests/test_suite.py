"""Nothing is lost between the gate, the stories and the labs."""

import re
from pathlib import Path

from _pytest.mark.expression import Expression

MAKEFILE = Path(__file__).parents[1] / "Makefile"


def selections(target):
    """What the calls of pytest that a target of the Makefile makes are asked for, without those of random examples."""
    lines = re.search(rf"^{target}: .*\n((?:\t.*\n|ifdef.*\n|else\n|endif\n)+)", MAKEFILE.read_text(), re.M)[
        1
    ]
    return [
        asked
        for line in lines.splitlines()
        if "hypothesis-profile" not in line
        for asked in re.findall(r'-m "([^"]+)"', line)
    ]


def test_every_test_is_made_by_just_one_of_the_three_commands():
    asked = [*selections("test"), *selections("labs")]
    assert asked == ["not story and not lab", "story", "lab"]  # tests/conftest.py knows the last two
    for marks in ({"story"}, {"lab"}, set()):
        takes = [one for one in asked if Expression.compile(one).evaluate(lambda name, **_: name in marks)]  # noqa: B023
        assert len(takes) == 1, (marks, takes)
