import tomllib

from hypothesis import example, given, settings
from hypothesis import strategies as st

from motorhil.harness.rig.config.toml import key_lines
from tests.support.repetition import examples


def test_every_kind_of_key_has_its_line():
    text = """\
# a comment with a [header] and a = 1 in it
top = 1

[rig]
name = "two [wheels]"  # seed = 0
"quoted key" = true
'literal.key' = 1

[bus.can0]
bitrate_bit_s = 1_000_000
plant.resistance_ohm = 1.5
plant.inductance_h = 1e-3

  [controller . "left" ]
eds = { path = "a.eds", node.id = 3 }
text = \"\"\"
[not.a.header]
key = 1 \\\"\"\"
\"\"\"\"\"
after = 1
literal = '''
it's = 2'' '''
mapping = [  # one
    "a", "]",
    # a comment, with ]
    { index = 1 },
    [2,
     3],
]

[[fault]]
kind = "drop"

[[fault]]
kind = "cut"
[fault.when]
from_s = 1979-05-27 07:32:00

[bus]
later = 1
"""
    lines = dict(key_lines(text))
    assert lines == {
        (): 1,
        ("top",): 2,
        ("rig",): 4,
        ("rig", "name"): 5,
        ("rig", "quoted key"): 6,
        ("rig", "literal.key"): 7,
        ("bus",): 39,
        ("bus", "can0"): 9,
        ("bus", "can0", "bitrate_bit_s"): 10,
        ("bus", "can0", "plant"): 11,
        ("bus", "can0", "plant", "resistance_ohm"): 11,
        ("bus", "can0", "plant", "inductance_h"): 12,
        ("controller",): 14,
        ("controller", "left"): 14,
        ("controller", "left", "eds"): 15,
        ("controller", "left", "eds", "path"): 15,
        ("controller", "left", "eds", "node"): 15,
        ("controller", "left", "eds", "node", "id"): 15,
        ("controller", "left", "text"): 16,
        ("controller", "left", "after"): 20,
        ("controller", "left", "literal"): 21,
        ("controller", "left", "mapping"): 23,
        ("controller", "left", "mapping", 0): 24,
        ("controller", "left", "mapping", 1): 24,
        ("controller", "left", "mapping", 2): 26,
        ("controller", "left", "mapping", 2, "index"): 26,
        ("controller", "left", "mapping", 3): 27,
        ("controller", "left", "mapping", 3, 0): 27,
        ("controller", "left", "mapping", 3, 1): 28,
        ("fault",): 31,
        ("fault", 0): 31,
        ("fault", 0, "kind"): 32,
        ("fault", 1): 34,
        ("fault", 1, "kind"): 35,
        ("fault", 1, "when"): 36,
        ("fault", 1, "when", "from_s"): 37,
        ("bus", "later"): 40,
    }
    assert set(lines) == paths_of(tomllib.loads(text))


def test_windows_line_ends_count_once():
    assert key_lines("a = 1\r\n\r\nb = 2\r\n")[("b",)] == 3


def test_quotes_before_the_closing_three_belong_to_the_string():
    for quoted in ('"""a"""""', "'''a'''''", '"""a""b"c"""', "'''a''b'c'''", '""""""', "''''''"):
        text = f"a = {quoted}\nb = 1\n"
        tomllib.loads(text)
        assert key_lines(text)[("b",)] == 2


def paths_of(value, path=()):
    found = {path}
    if isinstance(value, dict):
        for key, item in value.items():
            found |= paths_of(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            found |= paths_of(item, (*path, index))
    return found


def leaves_of(value, path=()):
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves_of(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from leaves_of(item, (*path, index))
    else:
        yield path, value


# Documents are built line by line from pieces, keeping what tomllib accepts. Each value carries a
# unique marker, so its expected line is known without a parser.
KEYS = st.sampled_from(["a", "b", '"c.d"', "'e]'", "f-1", "7"])
DOTTED = st.lists(KEYS, min_size=1, max_size=3).map(".".join)
VALUES = st.recursive(
    st.sampled_from(
        [
            '"@ # [x]\\""',
            "'@ ] } ='",
            '"""@\n[x]\na = 1\n\\""" """',
            "'''@\n[[x]]\nb = '' 2'''",
        ]
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda items: "[ # ]\n" + ",\n ".join(items) + "\n]"),
        st.lists(inner, max_size=3).map(lambda items: "[" + ", ".join(items) + "]"),
        st.lists(st.tuples(DOTTED, inner), max_size=3).map(
            lambda pairs: "{ " + ", ".join(f"{k} = {v}" for k, v in pairs) + " }"
        ),
    ),
    max_leaves=5,
)
LINES = st.one_of(
    st.tuples(DOTTED, VALUES).map(lambda pair: f"{pair[0]} = {pair[1]}  # [z]"),
    DOTTED.map(lambda key: f"[{key}]"),
    DOTTED.map(lambda key: f"[[{key}]]  # x"),
    st.sampled_from(["", "# a = 1", "  # [b]"]),
)


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(LINES, max_size=12))
@example(["[[a]]", "[a.b]", 'c = "@"', "[[a]]", "[a.b]", 'c = "@"'])
def test_every_path_of_any_valid_text_is_found_at_its_line(pieces):
    text = ""
    markers = 0
    for piece in pieces:
        filled = piece
        while "@" in filled:
            filled = filled.replace("@", f"m{markers}m", 1)
            markers += 1
        try:
            tomllib.loads(text + filled + "\n")
        except tomllib.TOMLDecodeError:
            continue
        text += filled + "\n"
    values = tomllib.loads(text)

    lines = key_lines(text)

    assert set(lines) == paths_of(values)
    written = text.split("\n")
    for path, value in leaves_of(values):
        marker = value[: value.index("m", 1) + 1]
        assert marker in written[lines[path] - 1]
