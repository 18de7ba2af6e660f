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
    assert "".join(said) == "1 of 2 the worker \n2 of 2 the web \n"


def test_a_step_that_lasts_is_not_silent(monkeypatch):
    monkeypatch.setattr(progress, "_DOT_EVERY_S", 0.01)
    said = []
    with Progress(said.append, 1).step("the database"):
        eventually(lambda: said.count(".") > 2, "dots")
    assert said[-1] == "\n"


def test_a_terminal_that_is_gone_holds_nothing_up(monkeypatch):
    monkeypatch.setattr(progress, "_DOT_EVERY_S", 0.01)
    tried = []

    def write(piece):
        tried.append(piece)
        raise OSError("gone")

    with Progress(write, 1).during("ending"):
        eventually(lambda: tried.count(".") > 1, "dots")
    assert tried[0] == "ending "
    assert tried[-1] == "\n"
