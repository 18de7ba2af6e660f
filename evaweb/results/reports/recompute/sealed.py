"""Schedule, codes and commitment, recomputed from the revealed key."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .designs import arms_of

_ALL_KEPT = 7  # plan format from which reveals keep a record without a comparison too
_IMBALANCE = (
    3  # lead of one of two checkpoints in random order, per condition, at which the other one is forced
)
_KEPT = (
    "pairs",
    "blocks",
    "arms",
    "headline",
    "caveats",
    "setting",
    "record",
    "measured",
    "judged",
    "conduct",
)  # parts of a reveal that its digest covers
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"


def digest(document: Any) -> str:
    """Return the SHA-256 of the canonical form."""
    text = json.dumps(_plain(document), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return the value with integral floats as integers, because writers of JSON differ in the decimal point."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list) else value


def _draws(key: bytes, name: str) -> Iterator[int]:
    drawn = 0
    while True:
        yield int.from_bytes(hmac.new(key, f"{name}/{drawn}".encode(), hashlib.sha256).digest()[:8], "big")
        drawn += 1


def _below(draws: Iterator[int], n: int) -> int:
    fair = 2**64 - 2**64 % n
    return next(drawn % n for drawn in draws if drawn < fair)


def _shuffled(draws: Iterator[int], items: Sequence[Any]) -> list[Any]:
    shuffled = list(items)
    for i in reversed(range(1, len(shuffled))):
        j = _below(draws, i + 1)
        shuffled[i], shuffled[j] = shuffled[j], shuffled[i]
    return shuffled


def schedule(plan: Mapping[str, Any], key: bytes) -> list[list[Any]]:
    """Return [index, block, checkpoint, scene, position, repetition] of every planned trial."""
    names = [row["name"] for row in plan["checkpoints"]]
    conditions = [(scene["name"], p["number"]) for scene in plan["scenes"] for p in scene["positions"]]
    draws, coins, k = _draws(key, "orders"), _draws(key, "allocation"), len(names)
    orders: list[list[str]] = []
    ahead: dict[tuple[str, int], int] = {}  # trials of the first checkpoint minus those of the second
    random_order = plan.get("allocation") == "random"
    units: list[list[Any]] = []
    block = 0
    for repetition in range(1, plan["repetitions"] + 1):
        for scene, position in _shuffled(_draws(key, f"conditions/{repetition}"), conditions):
            if random_order:
                for number in (2 * repetition - 1, 2 * repetition):
                    now = ahead.get((scene, position), 0)
                    at = int(now > 0) if abs(now) == _IMBALANCE else _below(coins, 2)
                    ahead[scene, position] = now + (1 - 2 * at)
                    units.append([len(units), block, names[at], scene, position, number])
                block += 1
                continue
            if plan.get("format", 1) >= 6:
                orders = [_shuffled(draws, names)]
            elif not orders:
                rows, columns = _shuffled(draws, names), _shuffled(draws, range(k))
                orders = _shuffled(draws, [[rows[(i + c) % k] for c in columns] for i in range(k)])
            for checkpoint in orders.pop(0):
                units.append([len(units), block, checkpoint, scene, position, repetition])
            block += 1
    return units


def counts(units: Sequence[Sequence[Any]], names: Sequence[str]) -> list[list[int]]:
    """Return for each block how many trials of each checkpoint in `names` are scheduled up to its end."""
    blocks = 1 + max(unit[1] for unit in units)
    return [[sum(u[2] == name for u in units if u[1] <= at) for name in names] for at in range(blocks)]


def codes(key: bytes, count: int) -> list[str]:
    """Return the codes in order of allocation."""
    draws, drawn = _draws(key, "codes"), dict[str, None]()
    while len(drawn) < count:
        drawn["".join(_LETTERS[_below(draws, len(_LETTERS))] for _ in range(5))] = None
    return list(drawn)


def faults(seal: Mapping[str, Any], plan: Mapping[str, Any], rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Return contradictions between plan, commitment, key and trials."""
    sentences = []
    if digest(plan) != seal["digest"]:
        sentences.append(
            f"plan.json has the digest {digest(plan)}, the plan that was frozen {seal['digest']}"
        )
    reveal = seal["at_reveal"]
    fields = (
        {name: reveal[name] for name in _KEPT if name in reveal} if reveal else {}
    )  # parts covered by the digest
    if reveal and digest({"plan": seal["digest"], **fields}) != reveal["digest"]:
        sentences.append(f"the pairs of the reveal have not the digest {reveal['digest']}")
    if not seal["key"]:
        return sentences
    version = plan.get(
        "format", 1
    )  # reveals record a digest from format 3 on, blocks and arms from 4 on, texts from 6 on
    kinds: tuple[str, ...] = (
        () if version < 3 else ("digest",) if version == 3 else ("digest", "blocks", "arms")
    )
    kinds += ("headline", "caveats", "record") if version >= 6 else ()
    kinds += ("setting", "measured", "judged", "conduct") if version >= _ALL_KEPT else ()
    required = kinds if arms_of(plan) or version >= _ALL_KEPT else ()
    sentences += [f"the reveal kept no {name}" for name in required if name not in (reveal or {})]
    key = bytes.fromhex(seal["key"])
    units = schedule(plan, key)
    committed = hmac.new(key, f"{seal['digest']}\n{digest({'units': units})}".encode(), hashlib.sha256)
    if (
        reveal
        and reveal.get("key", seal["key"]) == seal["key"]
        and reveal.get("commitment", seal["commitment"]) != seal["commitment"]
    ):
        sentences.append(
            f"the reveal was of the commitment {reveal['commitment']}, shown is {seal['commitment']}"
        )
    if committed.hexdigest() != seal["commitment"]:
        sentences.append(
            f"the key makes the commitment {committed.hexdigest()}, shown was {seal['commitment']}"
        )
    planned_counts, names = (
        plan["stopping"].get("counts"),
        arms_of(plan) or [row["name"] for row in plan["checkpoints"]],
    )
    if planned_counts and planned_counts != counts(units, names):
        sentences.append("the boundary is for other numbers of trials than those of the schedule")
    code_list = codes(key, max((int(row["order"]) for row in rows), default=0))
    for row in rows:
        unit = units[int(row["slot"])]
        own = [int(row["slot"]), int(row["block"]), row["checkpoint"], row["scene"], int(row["position"])]
        if unit[:5] != own or row["code"] != code_list[int(row["order"]) - 1]:
            sentences.append(f"trial {row['trial']} ({row['code']}) is not what the schedule foresaw: {unit}")
    return sentences
