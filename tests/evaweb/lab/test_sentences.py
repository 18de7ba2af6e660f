"""The catalogue of sentences, and that each is said with the arguments that it names."""

import ast
import json
from importlib import import_module
from io import StringIO

import pytest
from django.core.management import CommandError, call_command

from evaweb.lab import sentences
from runtime.core.sentences import Pattern, Sentence
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.lease import HIGHEST_EPOCH, Lease
from runtime.processes.coordinator.session import transitions
from runtime.processes.coordinator.setup.sequence import Stage
from tests.sources import ROOT

MODULES = list(sentences.modules())


def meant(node, module, local):
    """The patterns that a called expression may be; a Sentence is one that cannot be called."""
    if isinstance(node, ast.IfExp):
        return [*meant(node.body, module, local), *meant(node.orelse, module, local)]
    if isinstance(node, ast.Name) and node.id in local:
        return meant(local[node.id], module, {})
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        found = getattr(getattr(module, node.value.id, None), node.attr, None)
    else:
        found = getattr(module, node.id, None) if isinstance(node, ast.Name) else None
    return [found] if isinstance(found, Pattern | Sentence) else []


def given(call, local):
    """Names of the arguments of a call; None for a map that is not written beside it."""
    for keyword in call.keywords:
        if keyword.arg is not None:
            yield keyword.arg
            continue
        table = local.get(getattr(keyword.value, "id", ""))
        yield from (key.value for key in table.keys) if isinstance(table, ast.Dict) else (None,)


def assigned(function):
    simple = [n for n in ast.walk(function) if isinstance(n, ast.Assign) and len(n.targets) == 1]
    return {n.targets[0].id: n.value for n in simple if isinstance(n.targets[0], ast.Name)}


def said_wrongly(name):
    module = import_module(name)
    tree = ast.parse((ROOT / f"{name.replace('.', '/')}.py").read_text("utf-8"))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    for function in functions:
        local = assigned(function)
        for call in ast.walk(function):
            for pattern in meant(call.func, module, local) if isinstance(call, ast.Call) else ():
                names = set(given(call, local))
                if isinstance(pattern, Sentence) or call.args or names != pattern.names:
                    yield f"{name}:{call.lineno}: {getattr(pattern, 'id', pattern)} said with {names}"


def test_every_sentence_is_said_with_the_arguments_that_it_names():
    """Also those that no test hears: a refusal that fails to be said would be a fault instead."""
    assert len(MODULES) > 120
    assert [wrong for name in MODULES for wrong in said_wrongly(name)] == []


def test_the_catalogue_has_all_and_tells_what_a_language_lacks(tmp_path):
    out = StringIO()
    call_command("sentences", stdout=out)
    rows = {row["id"]: row for row in json.loads(out.getvalue())["sentences"]}
    assert rows["lease.held_by"] == {
        "id": "lease.held_by",
        "english": "{holder} holds the lease",
        "arguments": ["holder"],
    }
    file = tmp_path / "xx.json"
    words = {"lease.held_by": "{holder} hat sie"}
    file.write_text(json.dumps({"name": "X", "sentences": words}))
    out = StringIO()
    call_command("sentences", str(file), stdout=out)
    found = json.loads(out.getvalue())["sentences"]
    assert (len(found["missing"]), found["unknown"]) == (len(rows) - 1, [])
    wrong = {"lease.held_by": "{owner} hat sie", "lease.nobody_holds": "{0}", "no.such": "x"}
    file.write_text(json.dumps({"name": "X", "sentences": wrong}))
    out = StringIO()
    with pytest.raises(CommandError, match="unknown"):
        call_command("sentences", str(file), stdout=out)
    found = json.loads(out.getvalue())["sentences"]
    assert (found["unknown"], found["other_arguments"]) == (
        ["no.such"],
        ["lease.held_by", "lease.nobody_holds"],
    )
    file.write_text("[]")
    with pytest.raises(CommandError, match="expected"):
        call_command("sentences", str(file))


MODES = ("continuous", "step", "preview", "manual", "collect")
FACTS = [
    {},
    *(
        {name: True}
        for name in ("trial", "opening", "approaching", "has_proposal", "is_requesting", "executing")
    ),
    *({"mode": mode, "has_proposal": shown} for mode in MODES for shown in (True, False)),
    *({"mode": "step", name: True} for name in ("opening", "is_requesting", "executing")),
    {"mode": "preview", "approaching": True},
    *(
        {"collection": True, "collecting": collects, "armed": armed}
        for collects in (0, 1)
        for armed in (0, 1)
    ),
]


def reasons():
    """Every answer of a guard, in every state."""
    for rule in transitions.COMMANDS.values():
        for state in SessionState:
            yield from filter(None, (rule.guard(state, transitions.GuardFacts(**fact)) for fact in FACTS))


def test_states_stages_reasons_and_refusals_of_the_lease_are_sentences():
    lease = Lease(5.0)
    said = [lease.claim("", 0, 0.0), lease.claim("a", HIGHEST_EPOCH + 1, 0.0), lease.check("a", 0, 0.0)]
    assert lease.claim("a", 3, 0.0) == ""
    said += [
        lease.claim("b", 0, 1.0),
        lease.claim("b", 2, 1.0),
        lease.check("b", 3, 1.0),
        lease.check("a", 4, 1.0),
    ]
    said += [*transitions.REASONS.values(), transitions.CANCELLED, *reasons()]
    said += [text for state in SessionState for text in (state.sentence, state.meaning.label)]
    said += [stage.sentence for stage in Stage]
    assert [text for text in said if not isinstance(text, Sentence)] == []
    assert len({text.id for text in said}) > 50
