"""The seeded mistakes fit the tree; whether they are noticed is asked by hand: `python -m tests.mutants`."""

from collections import Counter
from pathlib import Path

import pytest

from tests.mutants.table import AREAS, MUTANTS, misfit

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_fits_its_file_and_has_tests_of_the_gate(mutant):
    assert misfit(mutant, ROOT) == ""
    assert mutant.old != mutant.new
    assert not mutant.path.startswith("tests/")
    assert mutant.tests
    assert not any(each.startswith(("tests/e2e/", "tests/crash/")) for each in mutant.tests)
    compile((ROOT / mutant.path).read_text("utf-8").replace(mutant.old, mutant.new), mutant.path, "exec")


def test_there_are_forty_mutants_of_six_areas_each_with_a_name_of_its_own():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) == 40
    found = Counter(mutant.name.split("/")[0] for mutant in MUTANTS)
    assert set(found) == set(AREAS)
    assert min(found.values()) >= 6


def test_a_row_that_does_not_fit_says_why(tmp_path):
    mutant = MUTANTS[0]
    assert misfit(mutant, tmp_path).endswith(f"there is no {mutant.path}")
    file = tmp_path / mutant.path
    file.parent.mkdir(parents=True)
    for text, said in (("", "occurs 0 times"), (2 * mutant.old, "occurs 2 times")):
        file.write_text(text)
        assert said in misfit(mutant, tmp_path)
    file.write_text(mutant.old)
    assert misfit(mutant, tmp_path).endswith(f"there is no {mutant.tests[0]}")
