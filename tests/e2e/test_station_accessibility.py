"""axe-core finds nothing on the pages of a station, while it runs too, in both themes, with keys and menu open."""

import pytest

from tests.e2e.axe import themed, violations
from tests.e2e.by_hand import DebugPage
from tests.e2e.lab import STATION, WIDE

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_axe_finds_nothing(browser, patient, theme):
    bench = DebugPage(browser, patient, "operator", WIDE)
    themed(bench.context, theme)

    def look(tab):
        bench.keys("?")
        bench.page.locator("#keys[open]").wait_for()
        assert violations(bench.page) == {}, tab
        bench.page.set_viewport_size(WIDE)

    for tab in ("collect", "eval", "debug"):
        bench.open(f"/stations/{STATION}/{tab}/").at_rest()
        bench.take_again()
        bench.cameras_live()
        look(tab)
    bench.set_up()
    bench.run_in("continuous")
    bench.page.locator("#curves-legend button").nth(3).wait_for()
    look("running")
    bench.press("stop")
    bench.open("/")
    assert violations(bench.page) == {}
    bench.close()
