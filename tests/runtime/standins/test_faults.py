from __future__ import annotations

import argparse

import pytest

from runtime.standins import faults


def test_a_fault_is_read_with_and_without_its_argument() -> None:
    assert faults.parse("nan") == faults.Fault("nan")
    assert faults.parse("die:3").number(0) == 3
    assert faults.parse("die").number(0) == 0
    assert faults.parse("action_mode:eef").argument == "eef"


@pytest.mark.parametrize(
    ("text", "says"), [("naan", "allowed: mute_on_connect"), ("die:soon", "expected a number")]
)
def test_a_wrong_fault_names_what_is_allowed(text: str, says: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=says):
        faults.parse(text)
