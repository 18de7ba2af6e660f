"""A server of a benchmark's experts: what it answers depends on observation and seed alone."""

from __future__ import annotations

import numpy as np
import pytest
from websockets.sync.client import connect

from runtime.standins.arrays import packed, unpacked
from runtime.standins.expert_server import ExpertServer

SEEN = np.linspace(-1.0, 1.0, 5)


def expert(instruction: str, seen: np.ndarray) -> np.ndarray:
    """Two rows of three numbers; like some experts of Meta-World it writes into what it is given."""
    if not instruction:
        raise ValueError("no task is named")
    seen[:3] += len(instruction)
    return np.stack([seen[:3], -seen[:3]])


def ask(server: ExpertServer, seen: np.ndarray, prompt: str = "go") -> np.ndarray:
    """The rows of a new client."""
    with connect(str(server.start()["url"])) as client:
        greeting = unpacked(client.recv())
        assert (greeting["policy"], greeting["action_horizon"]) == ("noisy", 2)
        client.send(packed({"observation/environment_state": seen, "prompt": prompt}))
        answer = client.recv()
    server.close()
    if isinstance(answer, str):
        raise ConnectionError(answer)
    return np.asarray(unpacked(answer)["actions"])


def serve(noise: float = 0.1, seed: int = 0) -> ExpertServer:
    return ExpertServer(expert, (5, 2), "noisy", noise, seed, 0)


def test_rows_are_the_expert_s_with_noise_of_seed_and_observation() -> None:
    plain = ask(serve(noise=0.0), SEEN)
    np.testing.assert_array_equal(plain, np.stack([SEEN[:3] + 2, -SEEN[:3] - 2]).astype(np.float32))
    noisy = ask(serve(), SEEN)
    assert noisy.dtype == np.float32
    assert 0 < np.abs(noisy - plain).max() < 1
    np.testing.assert_array_equal(ask(serve(), SEEN), noisy)
    for other in (ask(serve(seed=1), SEEN), ask(serve(), SEEN + 1e-12)):
        assert np.abs(other - noisy).max() > 1e-3


@pytest.mark.parametrize(
    ("seen", "prompt", "why"),
    [(SEEN[:4], "go", r"shape \(4,\); expected \(5,\)"), (SEEN, "", "no task is named")],
)
def test_what_it_cannot_answer_is_said(seen: np.ndarray, prompt: str, why: str) -> None:
    with pytest.raises(ConnectionError, match=why):
        ask(serve(), seen, prompt)
