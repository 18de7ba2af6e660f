"""Nothing is lost between the gate, the stories and the labs."""

import re
from pathlib import Path

import pytest
from _pytest.mark.expression import Expression

pytest_plugins = ["pytester"]

MAKEFILE = Path(__file__).parents[1] / "Makefile"


def selections(target):
    """What the calls of pytest that a target of the Makefile makes are asked for."""
    lines = re.search(rf"^{target}: .*\n((?:\t.*\n|if.*\n|else\n|endif\n)+)", MAKEFILE.read_text(), re.M)[1]
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


def test_a_mark_that_does_not_stand_in_its_file_is_refused(pytester: pytest.Pytester) -> None:
    root = str(MAKEFILE.parent)
    pytester.makeconftest(
        f"import sys\nsys.path.insert(0, {root!r})\nfrom tests.conftest import pytest_collection_modifyitems"
    )
    pytester.makepyprojecttoml(
        "[tool.pytest.ini_options]\nmarkers = ['lab', 'story']\naddopts = '-p no:django'"
    )
    pytester.makepyfile(marks="import pytest\nalone = getattr(pytest.mark, 'l' + 'ab')")
    pytester.makepyfile(test_it="import marks\n@marks.alone\ndef test_it():\n    pass")
    found = pytester.runpytest_subprocess("--collect-only")
    assert found.ret == pytest.ExitCode.USAGE_ERROR
    found.stderr.fnmatch_lines(
        ["*test_it.py::test_it is a story or a lab by a mark that does not stand in its file*"]
    )
