import re
from pathlib import Path

from runtime.config.reference import render_reference
from runtime.config.schema import Deployment
from runtime.core.plugins import variants

COMMITTED = Path(__file__).parents[3] / "docs" / "configuration.md"
ROW = re.compile(r"^\| `(\w+)` \| (.+?) \| (.+?) \| (.*?) \|$", re.MULTILINE)


def test_the_committed_file_is_what_the_models_say():
    assert COMMITTED.read_text("utf-8") == render_reference(), (
        "the keys of a deployment have changed: python -m runtime.config.reference > docs/configuration.md"
    )


def test_every_key_has_a_type_a_default_and_a_meaning():
    rows = ROW.findall(render_reference())
    assert len(rows) > 80
    assert [name for name, *cells in rows if not all(cell.strip() for cell in cells)] == []


def test_every_table_and_every_variant_has_its_section():
    text = render_reference()
    for name, field in Deployment.model_fields.items():
        if name in ("station", "robot", "task", "operator", "data_dir"):
            assert f"| `{name}` | string" in text
        elif name == "tasks":
            assert "| `tasks` | list of string | `[]` |" in text
        elif name == "groups":
            assert "| `groups` | list of string | none |" in text
        else:
            assert f"## `[{name}]`" in text or f"## `[{name}.NAME]`" in text, field
    for package, part in (("transports", "transport"), ("policies", "policy"), ("strategies", "strategy")):
        for kind in variants(f"runtime.{package}"):
            assert f"## `[{part}]` of kind `{kind}`" in text


def test_types_and_defaults_are_in_words():
    text = render_reference()
    assert '| `realtime` | `"auto"`, `"off"` | `"auto"` |' in text
    assert "| `rate` | number > 0, ≤ 1000 | none |" in text
    assert '| `blend_window` | integer ≥ 1 or `"all"` | `8` |' in text
    assert "| `image_size` | list of 2 × integer ≥ 8, ≤ 4096 | `[224, 224]` |" in text
    assert "| `lower` | list of 3 × number | required |" in text
    assert "## `[safety.workspace.NAME]`" in text
