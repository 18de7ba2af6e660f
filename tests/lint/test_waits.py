import ast

import pytest

from tests.lint.waits import waits


@pytest.mark.parametrize(
    "line",
    [
        "done.wait(20)",
        "client.wait(lambda state: state, 60)",
        "eventually(check, 'it is there', 30)",
        "socket.poll(5000)",
        "page.locator('#a').wait_for(timeout=150000)",
        "subprocess.run([], timeout=60)",
        "SOON = 20\nthread.join(SOON)",
        "pytestmark = pytest.mark.timeout(300)",
        "deadline = time.monotonic() + 10",
        "heard.get(timeout=30)",
        "TURN = 2\nLONG = 10 * TURN\nthread.join(LONG - 1)",
    ],
)
def test_a_wait_with_a_number_of_its_own_is_refused(line: str) -> None:
    assert len(list(waits(ast.parse(line)))) == 1


@pytest.mark.parametrize(
    "line",
    [
        "done.wait(PATIENCE_S)",
        "eventually(check, 'it is there')",
        "eventually(check, 'a long work is done', 3 * PATIENCE_S)",
        "socket.poll(50)",
        "assert not heard.wait(0.2)",
        "kinds.get('a', 20)",
    ],
)
def test_the_patience_of_all_a_turn_and_a_silence_are_allowed(line: str) -> None:
    assert list(waits(ast.parse(line))) == []
