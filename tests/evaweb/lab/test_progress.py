from evaweb.lab import progress
from evaweb.lab.progress import Progress
from tests.processes import eventually


def test_steps_are_numbered_and_each_has_a_line():
    said = []
    told = Progress(said.append, 2)
    with told.step("the worker"):
        pass
    with told.step("the web"):
        pass
    assert "".join(said) == "1 of 2 the worker\n2 of 2 the web\n"


def test_a_step_that_lasts_is_not_silent(monkeypatch):
    monkeypatch.setattr(progress, "_EVERY_S", 0.01)
    said = []
    with Progress(said.append, 1).step("the database"):
        eventually(lambda: len(said) > 3, "lines")
    assert said[0] == "1 of 1 the database\n"
    assert all(line.startswith("  ... still at it, ") for line in said[1:])


def test_a_terminal_that_is_gone_holds_nothing_up(monkeypatch):
    monkeypatch.setattr(progress, "_EVERY_S", 0.01)
    tried = []

    def write(piece):
        tried.append(piece)
        raise OSError("gone")

    with Progress(write, 1).during("ending"):
        eventually(lambda: len(tried) > 2, "lines")
    assert tried[0] == "ending\n"
