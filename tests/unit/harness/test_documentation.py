"""The sources of the site: generated pages are complete, and navigation follows the indexes."""

from motorhil import motorapi
from motorhil.harness.documentation import (
    api_page,
    build,
    command_line_page,
    rig_page,
    schema_page,
)


def test_command_line_page_has_a_section_for_every_verb():
    page = command_line_page()
    assert "\n## motorhil run\n" in page
    assert "--seed N" in page
    assert page.count("\n## ") > 10


def test_api_page_has_every_public_name():
    page = api_page()
    for name in motorapi.__all__:
        assert f"\n### {name}\n" in page, name
    assert "\n#### Motor.set_setpoint\n" in page


def test_rig_page_has_keys_with_type_and_default():
    page = rig_page()
    assert "| `seed` | integer" in page
    assert "(#controller)" in page


def test_schema_page_takes_any_schema_and_shows_a_key_once():
    schema = {
        "description": "A | B.",
        "properties": {
            "speed": {"type": "number", "minimum": 0, "default": 1.5, "description": "[m/s]"},
            "kind": {"enum": ["a", "b"]},
            "part": {"$ref": "#/$defs/Part"},
            "gone": False,
        },
        "required": ["kind"],
        "allOf": [{"if": {}, "then": {"properties": {"kind": {"type": "string"}}}}],
        "$defs": {"Part": {"type": "object", "properties": {"x": {"type": ["integer", "null"]}}}},
    }
    rows = [line for line in schema_page(schema, "T").splitlines() if line.startswith("| `")]
    assert rows == [
        r"| `speed` | number, ≥ 0 | `1.5` | \[m/s\] |",
        '| `kind` (required) | `"a"`, `"b"` |  |  |',
        "| `part` | [Part](#part) |  |  |",
        "| `x` | integer or null |  |  |",
    ]


def test_navigation_is_made_of_the_links_of_each_index(tmp_path):
    docs, target = tmp_path / "docs", tmp_path / "built"
    (docs / "reference").mkdir(parents=True)
    (docs / "index.md").write_text("# T\n\n[a](reference/a.md) [r](reference/index.md)\n")
    (docs / "reference" / "index.md").write_text("# R\n\n[a](a.md) [again](a.md#x)\n")
    (docs / "reference" / "a.md").write_text("# A\n")
    build(docs, target)
    assert (target / "index.md").read_text().endswith(":hidden:\n\nreference/index\n```\n")
    navigation = (target / "reference" / "index.md").read_text().rpartition(":hidden:\n\n")[2]
    assert navigation == "a\ncli\nrig\napi\n```\n"
