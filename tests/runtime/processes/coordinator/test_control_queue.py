import mmap

import numpy as np
import pytest

from runtime.core.errors import RuntimeFault
from runtime.ipc.messages import NodeRequest, Order, PostedChunk, decode
from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.processes.coordinator.control_queue import ControlQueue

LAYOUT = SharedStateLayout(dim=2, eef_dim=8, cameras=())


@pytest.fixture
def shared():
    return SharedState(LAYOUT, mmap.mmap(-1, SharedState.size(LAYOUT)))


def obey(shared, number):
    status = shared.control.read().copy()
    status["order"] = number
    shared.control.write(status)


def read(shared):
    return [decode(payload) for payload in shared.rings["orders"].drain()]


def test_orders_are_numbered_and_arrive_in_order(shared):
    orders = ControlQueue(shared)
    assert orders.send_order("hold", run=3, reason="halted") == 1
    assert orders.send_order("motion", goal=np.array([0.5, 1.0])) == 2
    first, second = read(shared)
    assert first == Order(1, "hold", 3, None, "halted")
    assert (second.number, second.kind, second.goal.tolist()) == (2, "motion", [0.5, 1.0])


def test_a_restarted_main_counts_on_from_what_control_has_obeyed(shared):
    obey(shared, 41)
    orders = ControlQueue(shared)
    assert orders.send_order("follow", run=1) == 42
    assert read(shared)[0].number == 42


def test_chunks_keep_their_numbers_and_their_place_among_the_orders(shared):
    orders = ControlQueue(shared)
    orders.send_order("follow", run=1)
    orders.send_chunk(PostedChunk(orders.next_chunk(), 1, 10, np.zeros((3, 2))))
    orders.send_order("hold", run=1)
    assert [type(message) for message in read(shared)] == [Order, PostedChunk, Order]
    assert orders.next_chunk() == 2


def test_a_word_for_the_node_goes_the_way_of_the_orders(shared):
    orders = ControlQueue(shared)
    orders.send_order("hold")
    orders.send_node_request("scene_reset", {"id": "r", "seed": 3})
    assert read(shared)[1] == NodeRequest("scene_reset", {"id": "r", "seed": 3})


def test_a_control_that_does_not_read_is_a_fault_and_not_silence(shared):
    orders = ControlQueue(shared)
    large = PostedChunk(1, 1, 10, np.zeros((40_000, 2)))
    orders.send_chunk(large)
    with pytest.raises(RuntimeFault, match="control does not read its orders: the ring is full"):
        orders.send_chunk(large)
