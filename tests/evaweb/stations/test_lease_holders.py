"""Names of holders, as the runtime knows them and as people do."""

from __future__ import annotations

import pytest

from evaweb.stations.lease_holders import holder_display_name, holder_of, with_display_names


def test_a_page_holds_under_its_user_and_its_own_name():
    assert holder_of("ann", "p1") == "web:ann:p1"
    assert holder_display_name("web:ann:p1") == "ann"
    assert holder_display_name("terminal:ann@bench") == "terminal:ann@bench"


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("web:ann:0f60a36a-7c_0 holds the lease", "ann holds the lease"),
        (
            "web:a.b@lab.org:p1 holds the lease for another 3.2 s",
            "a.b@lab.org holds the lease for another 3.2 s",
        ),
        ("terminal:ann@bench holds the lease", "terminal:ann@bench holds the lease"),
        (
            "no policy server listens at ws://127.0.0.1:1: start it",
            "no policy server listens at ws://127.0.0.1:1: start it",
        ),
    ],
)
def test_a_sentence_of_the_runtime_names_people_not_pages(said, shown):
    assert with_display_names(said) == shown
