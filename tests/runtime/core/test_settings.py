from typing import Annotated

import pytest
from pydantic import AfterValidator, Field, ValidationError
from pydantic_core import PydanticCustomError

from runtime.core.settings import Settings, explain_validation_error


class Leg(Settings):
    length: float = Field(gt=0)
    colour: str = "black"


class Table(Settings):
    legs: list[Leg]
    name: str = ""


def explained(tree, **more):
    with pytest.raises(ValidationError) as invalid:
        Table.model_validate(tree)
    return explain_validation_error(invalid.value, Table, tree, "shop", **more)


def test_a_key_deep_inside_is_named_with_its_way_there_and_what_is_allowed_beside_it():
    said = explained({"legs": [{"length": 1.0}, {"length": 1.0, "color": "red"}]})
    assert said == (
        "shop: legs.1.color = 'red': unknown key (did you mean colour?); allowed here: colour, length"
    )


def test_each_error_has_a_line():
    said = explained({"legs": [{"length": 0.0}, {}], "name": 3}).splitlines()
    assert said == [
        "shop: legs.0.length = 0.0: Input should be greater than 0",
        "shop: legs.1.length is missing and has no default",
        "shop: name = 3: Input should be a valid string",
    ]


def test_a_key_that_came_from_elsewhere_is_blamed_on_where_it_came_from():
    said = explained({"legs": 3, "name": 3}, origin={("name",): "label.toml"}).splitlines()
    assert said == [
        "shop: legs = 3: Input should be a valid list",
        "label.toml: name = 3: Input should be a valid string",
    ]


def test_what_was_given_is_cut_where_it_is_endless():
    said = explained({"legs": [], "name": ["x"] * 100_000})
    assert said.startswith("shop: name = ['x', 'x'")
    assert len(said) < 300


def _no_secret(value):
    raise PydanticCustomError("secret", "name a file")


class Keyed(Settings):
    key: Annotated[str, AfterValidator(_no_secret)]


def test_secrets_are_not_shown():
    tree = {"key": "hush", "Passphrase": "hush", "api_token": "hush"}
    with pytest.raises(ValidationError) as invalid:
        Keyed.model_validate(tree)
    assert explain_validation_error(invalid.value, Keyed, tree, "shop").splitlines() == [
        "shop: key: name a file",
        "shop: Passphrase: unknown key; allowed here: key",
        "shop: api_token: unknown key; allowed here: key",
    ]
