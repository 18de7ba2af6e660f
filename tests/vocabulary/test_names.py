import ast

import pytest

from tests.vocabulary.names import definitions, parts_of, problems


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("_look_at", ["look", "at"]),
        ("HeldLease", ["held", "lease"]),
        ("LOOKS_2", ["looks", "2"]),
        ("__init__", ["init"]),
    ],
)
def test_a_name_is_read_word_by_word(name: str, parts: list[str]) -> None:
    assert parts_of(name) == parts


def test_every_definition_has_its_qualified_name_wherever_it_is() -> None:
    tree = ast.parse("class A:\n    def b(self):\n        def c(): ...\nif x:\n    async def d(): ...")

    assert list(definitions(tree)) == ["A", "A.b", "A.b.c", "d"]


def test_a_new_name_is_refused_and_the_list_has_none_for_nothing() -> None:
    assert list(problems({"a B.told", "a rest_pose"}, {"a rest_pose", "a gone"})) == [
        "a B.told: told: use the field's word (docs/glossary.md)",
        "a gone: no such definition; remove it from tests/vocabulary/avoided.txt",
    ]
