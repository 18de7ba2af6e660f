"""Attacks on the process for stops: presses with unknown tokens, and halts by an operator."""

from __future__ import annotations

import json
from collections import Counter
from uuid import uuid4

from benchmarks.attacks.requests import again_and_again
from benchmarks.attacks.target import Target
from benchmarks.estop_presses import RestPresser
from evaweb.accounts.roles import Role

_TOKENS, _HALTS = 64, 32


def unknown_tokens(target: Target) -> Counter[str]:
    """Press the e-stop from 64 clients, each time with a new unknown token."""

    def press(target: Target, number: int) -> str:
        program = RestPresser(target.stops, {"Authorization": f"Bearer eva_{uuid4().hex}"})
        return f"answered {program.press('made up').status or 'nothing'}"

    return again_and_again(target, target.part(_TOKENS), press)


def halts(target: Target) -> Counter[str]:
    """Send halts without a lease from 32 clients of one operator, repeatedly."""
    operator = target.visitor(Role.OPERATOR)
    headers = {"Cookie": operator.cookies, "X-CSRFToken": operator.csrf_token}

    def halt(target: Target, number: int) -> str:
        order = {"kind": "halt", "page": "attack", "epoch": 0, "uuid": str(uuid4())}
        program = RestPresser(target.stops, headers | {"Origin": target.url})
        return f"answered {program.post('POST', 'commands', json.dumps(order)).get('status', 'an error')}"

    return again_and_again(target, target.part(_HALTS), halt)
