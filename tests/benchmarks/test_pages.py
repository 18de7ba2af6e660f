from benchmarks import pages


def row(name, draws=False, **found):
    return {"page": name, "draws": draws, "fcp": 1, "lcp": 2, "inp": 3, "cls": 0, "kb": 4, "axe": []} | found


def test_figures_are_medians_of_loads_and_pages_with_3d_have_wanted_values_of_their_own():
    loads = [row("home", lcp=value) for value in (900, 1200, 800, 950, 1500)]
    found = {
        figure.name: figure
        for figure in pages.figures([*loads, row("eval", True, lcp=2000, cls=0.03, axe=["label", "region"])])
    }
    assert (found["lcp_ms.home"].value, found["lcp_ms.home"].holds) == (950, True)
    assert (found["lcp_3d_ms.eval"].value, found["lcp_3d_ms.eval"].holds) == (2000, True)
    assert found["cls.eval"].holds is False
    assert "lcp_ms.eval" not in found
    assert (found["axe_violations"].value, found["axe_violations"].holds) == (2, False)
