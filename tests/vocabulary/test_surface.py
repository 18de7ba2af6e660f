"""No rename of ours changes what others use; who means to writes tests/vocabulary/surface.json anew."""

import json

from tests.vocabulary.surface import GOLDEN, surface


def test_the_public_surface_is_as_it_was():
    now = json.loads(json.dumps(surface(), sort_keys=True))
    before = json.loads(GOLDEN.read_text("utf-8"))
    assert now.keys() == before.keys()
    for part, kept in before.items():
        assert now[part] == kept, f"{part}: python -m tests.vocabulary.surface, where that is meant"
