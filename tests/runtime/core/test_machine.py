"""What of a machine affects results, and the name of its kind."""

from __future__ import annotations

import pytest

from runtime.core import machine
from runtime.core.machine import machine_kind, processor

CPUINFO = """\
processor\t: 0
model name\t: A Processor
flags\t\t: fpu avx2 sse4_2 hypervisor md_clear

processor\t: 1
model name\t: Another
"""


@pytest.fixture
def cpuinfo(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_CPUINFO", tmp_path / "cpuinfo")
    processor.cache_clear()
    yield tmp_path / "cpuinfo"
    processor.cache_clear()


def kind(cpuinfo, text):
    cpuinfo.write_text(text)
    processor.cache_clear()
    return machine_kind()


def test_only_what_computations_depend_on_makes_another_kind(cpuinfo, monkeypatch):
    first = kind(cpuinfo, CPUINFO)
    assert processor()["model"] == "A Processor"
    assert processor()["features"] == "avx2 fpu sse4_2"
    assert kind(cpuinfo, CPUINFO.replace("md_clear", "ibrs")) == first
    assert kind(cpuinfo, CPUINFO.replace("avx2", "avx2 avx512f")) != first
    monkeypatch.setattr(machine, "version", lambda package: "0.1")
    assert kind(cpuinfo, CPUINFO) != first


def test_a_machine_that_does_not_say_has_no_model(cpuinfo):
    assert processor()["model"] == ""
    assert len(machine_kind()) == 8
