"""What no linter of imports sees."""

import re

from tests.sources import ROOT


def test_nothing_in_the_runtime_names_a_robot():
    robots = [path.parent.name for path in (ROOT / "robots").glob("*/robot.toml")]
    names = {name for robot in robots for name in (robot, robot.replace("_", "-"), robot.replace("_", " "))}
    pattern = re.compile("|".join(map(re.escape, sorted(names))), re.IGNORECASE)
    files = sorted((ROOT / "runtime").rglob("*.py"))
    assert len(robots) == 6
    assert len(files) > 400
    assert {
        str(path.relative_to(ROOT)): found
        for path in files
        if (found := pattern.findall(path.read_text("utf-8")))
    } == {}
