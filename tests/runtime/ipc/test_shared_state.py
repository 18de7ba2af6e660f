import os

import numpy as np
import pytest

from runtime.core.types import Observation
from runtime.ipc.shared_state import PICTURE_SLOTS, EStop, SharedState, SharedStateLayout

LAYOUT = SharedStateLayout(dim=3, eef_dim=8, cameras=("cam_high", "cam_wrist"), picture_bytes=4 * 6 * 3)


@pytest.fixture
def shared():
    made, descriptor = SharedState.create(LAYOUT)
    yield made
    os.close(descriptor)


def observation(sequence: int = 1, **changes) -> Observation:
    fields = {
        "sequence": sequence,
        "arrived": 2.0,
        "captured": {"joints": 1.9, "cam_high": 1.8},
        "qpos": np.arange(3, dtype=np.float32),
        "pictures": {},
    }
    return Observation(**(fields | changes))


def test_nothing_may_be_sent_before_the_guard_has_spoken(shared):
    assert shared.estop is EStop.UNKNOWN
    shared.set_estop(EStop.LATCHED)
    assert shared.estop is EStop.LATCHED


def test_a_second_mapping_sees_the_same_beats():
    first, descriptor = SharedState.create(LAYOUT)
    second = SharedState.attach(LAYOUT, descriptor)
    first.beat("media", 12.5)
    assert second.last_beat("media") == 12.5
    assert second.last_beat("control") == 0.0
    os.close(descriptor)


def test_an_observation_comes_back_with_its_picture(shared):
    picture = np.full((4, 6, 3), 7, np.uint8)
    shared.pictures["cam_high"].write(1, picture)
    shared.publish_observation(observation(eef=np.ones(8, np.float32)), {"cam_high": 1})
    seen = shared.read_observation(("cam_high", "cam_wrist"))
    assert seen.sequence == 1
    assert (seen.qpos == [0, 1, 2]).all()
    assert (seen.eef == 1).all()
    assert seen.qvel is None
    assert (seen.pictures["cam_high"] == picture).all()
    assert "cam_wrist" not in seen.pictures
    assert seen.captured["cam_high"] == 1.8


def test_no_observation_is_none_and_not_zeros(shared):
    assert shared.read_observation(()) is None


def test_a_picture_that_was_overwritten_is_not_handed_out(shared):
    slots = shared.pictures["cam_high"]
    slots.write(1, np.zeros((4, 6, 3), np.uint8))
    slots.write(1 + PICTURE_SLOTS, np.ones((4, 6, 3), np.uint8))
    assert slots.read(1) is None
    assert (slots.read(1 + PICTURE_SLOTS) == 1).all()


def test_a_picture_too_large_is_an_error_that_says_so(shared):
    with pytest.raises(ValueError, match="at most 72 fit"):
        shared.pictures["cam_high"].write(1, np.zeros((5, 6, 3), np.uint8))
