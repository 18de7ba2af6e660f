"""Effects of fingers on a block: they push it, align it between the jaws, and hold it."""

from __future__ import annotations

import math

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.block import Block
from runtime.simulation.bench.hands import FINGER_RADIUS, Hand

TILT = math.radians(25.0)  # largest tilt of the fingers from vertical; beyond it the block slips
TURN = math.radians(
    30.0
)  # largest angle between jaws and block; beyond it they meet its corners and it slips
SIDE = 0.02  # [m] largest offset of the block's centre along the fingers' width
LOW, HIGH = -0.035, 0.015  # [m] from the fingertips ahead to the block's centre, for a grasp
RELEASE = 0.003  # [m] opening beyond the block's width at which it falls
_REACH = 0.005  # [m] beyond the block's side at which the fingers' width still meets it
_DEEPEST = -0.06  # [m] from the fingertips; farther up between the fingers is the palm
_BARELY = 0.002  # [m] by which fingers must reach past the block's top to touch it
_SLACK = 1e-4  # [m] tolerance
_YIELD = 0.3  # [m/s] speed at which a block yields to a finger that presses from above


def squeeze(hand: Hand, before: Hand, block: Block) -> float | None:
    """Move a block that is between closing jaws.

    Return the opening [m] at which the block stops the jaws; None if the block does not stop them.

    `before` is the hand one step ago. The block counts as between the jaws only if the jaws were wide enough for it
    then. The jaws shift the block and rotate it into alignment. If they hold it from above, the block is attached to
    the arm.
    """
    place = hand.tip[:3, :3].T @ (block.pose[:3, 3] - hand.tip[:3, 3])
    if before.opening < _width(block, _turn(hand, block)) - _SLACK or not _between(hand, block, place):
        return None
    width = _straighten(hand, block)
    along = hand.tip[:2, 1] / np.hypot(*hand.tip[:2, 1])
    room = max(0.0, (hand.opening - width) / 2)
    block.shift(along * (np.clip(place[1], -room, room) - place[1]))
    if hand.opening >= width:
        return None
    if width <= block.edge + _SLACK and _from_above(hand, place):
        block.attach_to(hand.arm, hand.tip)
    return width


def push(hand: Hand, block: Block, seconds: float) -> None:
    """Move a block out of the finger that is deepest in it, at most at the hand's speed plus _YIELD."""
    deepest, towards = 0.0, np.zeros(2)
    for ball in hand.balls():
        if block.bottom - FINGER_RADIUS < ball[2] < block.top + FINGER_RADIUS:
            depth, direction = _overlap(block, ball[:2])
            if depth > deepest:
                deepest, towards = depth, direction
    block.shift(towards * min(deepest, (hand.speed + _YIELD) * seconds))


def _between(hand: Hand, block: Block, place: Float64) -> bool:
    x, y, ahead = place
    return (
        block.level
        and abs(x) <= block.edge / 2 + _REACH
        and abs(y) <= hand.opening / 2 + _SLACK
        and _DEEPEST <= ahead <= block.edge / 2 - _BARELY
        and bool(np.hypot(*hand.tip[:2, 1]) > 0.5)
    )


def _from_above(hand: Hand, place: Float64) -> bool:
    return bool(abs(place[0]) <= SIDE and LOW <= place[2] <= HIGH and hand.tilt <= TILT)


def _turn(hand: Hand, block: Block) -> float:
    """Return the angle about the vertical from the jaws to the nearest side of the block, in [-pi/4, pi/4]."""
    x, y = block.offset(block.pose[:2, 3] + hand.tip[:2, 1])
    angle = -math.atan2(y, x)
    return angle - round(angle / (math.pi / 2)) * math.pi / 2


def _width(block: Block, turn: float) -> float:
    """Return the distance [m] between two parallel jaws that touch a block, if it is rotated by `turn` relative to
    them.
    """
    return block.edge * (math.cos(turn) + math.sin(abs(turn)))


def _straighten(hand: Hand, block: Block) -> float:
    """Rotate the block as far as the closing jaws force it; return its width in their direction [m]."""
    turn = _turn(hand, block)
    width = _width(block, turn)
    if hand.opening >= width or abs(turn) > TURN:
        return width
    width = max(hand.opening, block.edge)
    left = math.asin(min(1.0, width / (block.edge * math.sqrt(2)))) - math.pi / 4  # width = _width(left)
    block.turn(math.copysign(left, turn) - turn)
    return width


def _overlap(block: Block, centre: Float64) -> tuple[float, Float64]:
    """Return how deep a finger's ball at `centre` [2] is in the block, and the direction [2] that moves the
    block out.
    """
    nearest = block.nearest(centre)
    away = nearest - centre
    distance = float(np.hypot(*away))
    if distance > 1e-9:
        return FINGER_RADIUS - distance, away / distance
    offset = block.offset(centre)
    side = int(np.argmax(np.abs(offset)))
    depth = FINGER_RADIUS + block.edge / 2 - abs(offset[side])
    return float(depth), -math.copysign(1.0, offset[side]) * block.sides()[:, side]
