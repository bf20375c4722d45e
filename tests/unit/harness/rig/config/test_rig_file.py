from pathlib import Path

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.config.rig_file import Known, parse_rig, read_rig
from motorhil.harness.rig.config.toml import RigError, Source, one_line

KNOWN = Known(
    controllers=("cia402", "io"),
    adaptations=("cia402", "ideal", "servo"),
    needs_bus={"cia402": True, "ideal": False, "servo": True, "broken": None}.get,
)

GOOD = """\
[rig]
name = "two wheels"
seed = 7

[bus.can0]
bitrate_bit_s = 1_000_000

[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
[controller.left.plant]
resistance_ohm = 1.5

[controller.right]
kind = "cia402"
bus = "can0"
node_id = 2
plant.from_motor_model = true

[motor.left]
adaptation = "cia402"
controller = "left"
[motor.left.model]
name = "wheel"

[motor.spare]
adaptation = "servo"
bus = "can0"
node_id = 9
heartbeat_s = 0.1
model = {}

[group.drive]
motors = ["left", "spare"]

[[fault]]
bus = "can0"
kind = "drop"
identifier = 0x181
until_s = 2

[[fault]]
bus = "can0"
kind = "cut"
nodes = ["right"]
"""


def parse(text, name="rig.toml"):
    return parse_rig(Source(Path(name), text), KNOWN)


def refusal(text):
    error = mistake_in(text)
    assert error is not None
    return str(error)


def mistake_in(text):
    try:
        parse(text)
    except RigError as error:
        return error
    return None


def test_rig_is_read_as_written():
    rig = parse(GOOD)
    assert (rig.name, rig.seed) == ("two wheels", 7)
    assert rig.buses["can0"].bitrate_bit_s == 1_000_000
    assert list(rig.controllers) == ["left", "right"]
    assert rig.controllers["left"].settings == {"node_id": 1, "plant": {"resistance_ohm": 1.5}}
    assert rig.controllers["left"].plants_from_model == ()
    assert rig.controllers["right"].settings == {"node_id": 2, "plant": {}}
    assert rig.controllers["right"].plants_from_model == (("plant",),)
    left, spare = rig.motors.values()
    assert (left.bus, left.node_id, left.controller) == ("can0", 1, "left")
    assert left.model == {"name": "wheel"}
    assert (spare.bus, spare.node_id, spare.controller) == ("can0", 9, None)
    assert spare.settings == {"heartbeat_s": 0.1}
    assert rig.groups["drive"].motors == ("left", "spare")
    drop, cut = rig.faults
    assert (drop.bus, drop.rule.name, drop.rule.kind) == ("can0", "fault 1", FaultKind.DROP)
    assert (drop.rule.identifier, drop.rule.until_ns) == (0x181, 2_000_000_000)
    assert (cut.rule.name, cut.rule.ports, cut.rule.probability) == ("fault 2", ("right",), 1.0)


def test_every_fault_condition_reaches_its_rule():
    conditions = """
[[fault]]
name = "bad gateway"
bus = "can0"
kind = "corrupt"
identifier = 0x1ABCDEF0
identifier_mask = 0x1FFFFF00
extended = true
sender = "host"
nodes = ["left", "right"]
from_s = 0.5
until_s = 1.5
probability = 0.25
skip = 3
limit = 4
flip = "00 FF"
[[fault]]
bus = "can0"
kind = "delay"
delay_s = 0.02
"""
    corrupt, delay = [fault.rule for fault in parse(GOOD + conditions).faults[2:]]
    assert corrupt == FaultRule(
        name="bad gateway",
        kind=FaultKind.CORRUPT,
        identifier=0x9ABCDEF0,
        mask=0x9FFFFF00,
        sender="host",
        ports=("left", "right"),
        from_ns=500_000_000,
        until_ns=1_500_000_000,
        probability=0.25,
        skip=3,
        limit=4,
        flip=b"\x00\xff",
    )
    assert delay == FaultRule(name="fault 4", kind=FaultKind.DELAY, delay_ns=20_000_000)


def test_rig_without_a_name_is_named_after_its_file():
    assert parse("[bus.can0]\nbitrate_bit_s = 500_000\n", "bench.toml").name == "bench"


WITHOUT_BUS = """\
[motor.left]
adaptation = "ideal"
axis = "shaft"
model = {}
[group.all]
motors = ["left"]
"""


def test_rig_whose_motors_need_no_bus_may_have_none():
    rig = parse(WITHOUT_BUS)
    left = rig.motors["left"]
    assert (left.bus, left.node_id, left.controller) == (None, None, None)
    assert left.settings == {"axis": "shaft"}
    assert not rig.buses


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "1: the rig has no bus; add [bus.can0]"),
        (WITHOUT_BUS.replace("ideal", "servo"), "1: the rig has no bus; add [bus.can0]"),
        (
            "[motor.a]\nmodel = {}\n",
            '1: motor.a.adaptation: is missing; write adaptation = "cia402"',
        ),
        (WITHOUT_BUS.replace("ideal", "ideel"), "2: motor.left.adaptation: unknown adaptation"),
        (WITHOUT_BUS + '[controller.c]\nkind = "io"\nbus = "can0"\n', "1: the rig has no bus"),
    ],
)
def test_rig_without_a_bus_is_refused_with_the_reason(text, told):
    assert refusal(text).startswith(f"rig.toml:{told}")


def test_motor_place_stays_open_for_a_broken_adaptation():
    known = Known((), ("broken",), needs_bus=lambda adaptation: None)
    text = WITHOUT_BUS.replace("ideal", "broken")
    motor = parse_rig(Source(Path("rig.toml"), text), known).motors["left"]
    assert (motor.bus, motor.controller) == (None, None)


# Mistakes in a rig, and the one line of error.
REFUSALS = [
    tuple(line[2:] for line in block.splitlines())
    for block in (Path(__file__).parent / "rig_refusals.txt").read_text().split("\n\n")[1:]
]


def unescaped(text):
    return text.replace("\\n", "\n").replace("\\\n", "\\n").replace("\\\\", "\\")


@pytest.mark.parametrize(("old", "new", "told"), REFUSALS)
def test_mistake_is_one_line_with_file_line_key_and_remedy(old, new, told):
    old, new = unescaped(old), unescaped(new)
    assert old in GOOD
    message = refusal(GOOD.replace(old, new, 1))
    assert one_line(message) == message
    assert message == f"rig.toml:{told}"


def test_rig_error_attributes_hold_the_facts():
    with pytest.raises(RigError) as caught:
        parse(GOOD.replace("seed = 7", "sede = 7"))
    error = caught.value
    assert (error.file, error.line, error.key) == (Path("rig.toml"), 3, "rig.sede")
    assert error.remedy == "did you mean seed?"


def test_missing_rig_is_reported_with_the_new_command(tmp_path):
    path = tmp_path / "nope.toml"
    with pytest.raises(RigError) as caught:
        read_rig(path, KNOWN)
    assert str(caught.value) == (
        f"{path}: no such file; check the path, or write a new rig: motorhil new DIR"
    )
    with pytest.raises(RigError, match="is a folder, not a file"):
        read_rig(tmp_path, KNOWN)


def test_rig_that_is_not_utf_8_is_reported_with_its_line(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b'[rig]\nname = "Stra\xdfe"\n')
    with pytest.raises(RigError) as caught:
        read_rig(path, KNOWN)
    assert str(caught.value) == f"{path}:2: not UTF-8 (byte DFh); save it as UTF-8"


def test_byte_order_mark_is_ignored(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\xef\xbb\xbf[bus.can0]\r\nbitrate_bit_s = 500_000\r\n")
    assert read_rig(path, KNOWN).buses["can0"].bitrate_bit_s == 500_000


def test_deep_nesting_is_refused():
    message = refusal("[rig]\nname = " + "[" * 100_000 + "]" * 100_000)
    assert "nested too deeply" in message


def test_key_of_many_parts_is_refused_at_its_line():
    message = refusal("[rig]\nseed = 1\n" + "a." * 2000 + "a (\n[a]\n")
    assert "rig.toml:3: nested too deeply" in message


TOKENS = st.sampled_from(
    [
        *("[", "]", "[[", "]]", "{", "}", "=", ".", ",", '"', "'", '"""', "\n", "#", " ", "\\"),
        *("rig", "bus", "can0", "node_id", "kind", "-1", "1e999", "nan", "true", "1979-05-27"),
        *("0x1F", "[rig]\n", "[bus]\n", "[[bus]]\n", "a = 1\n", "motor.x = 1\n", "\x00", "\ud7ff"),
        *("[[fault]]\n", "from_motor_model = true\n", "model = {}\n", "9" * 5000, "{" * 500),
    ]
)
EDITS = st.lists(
    st.tuples(st.integers(0, len(GOOD)), st.integers(0, 30), TOKENS | st.text(max_size=5)),
    min_size=1,
    max_size=4,
)


@given(EDITS)
def test_any_text_gives_a_rig_or_one_line_of_error(edits):
    text = GOOD
    for at, length, token in edits:
        text = text[:at] + token + text[at + length :]
    error = mistake_in(text)
    event(error.message.split("(")[0][:30] if error else "accepted")
    if error:
        assert str(error).startswith("rig.toml:")
        assert len(str(error).splitlines()) == 1
        assert 1 <= error.line <= text.count("\n") + 1


LINE_EDITS = st.tuples(
    st.lists(st.integers(0, GOOD.count("\n") - 1), max_size=8), st.booleans(), st.randoms()
)


def edited(edits, text=GOOD):
    """Return the text without some of its lines, perhaps with one moved."""
    dropped, moves, random = edits
    lines = [line for number, line in enumerate(text.splitlines()) if number not in dropped]
    if moves:
        line = lines.pop(random.randrange(len(lines)))
        lines.insert(random.randrange(len(lines)), line)
    return "\n".join(lines)


@given(LINE_EDITS)
def test_missing_or_moved_lines_give_a_rig_or_one_line_of_error(edits):
    error = mistake_in(edited(edits))
    event(error.message.split("(")[0][:30] if error else "accepted")
    assert error is None or len(str(error).splitlines()) == 1


def test_table_instead_of_an_array_of_tables_is_refused():
    message = refusal('[bus.can0]\nbitrate_bit_s = 500_000\n[fault]\nkind = "cut"\n')
    assert message == (
        "rig.toml:3: fault: must be an array of tables, but is a table (1 entry); write [[fault]]"
    )


VALUES = st.recursive(
    st.one_of(
        st.sampled_from(["true", "false"]),
        st.integers(-(2**70), 2**70).map(str),
        st.sampled_from(["nan", "-inf", "1e-400", "07:32:00", '""', "'x'", '"can0"', '"left"']),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda items: "[" + ",".join(items) + "]"),
        inner.map(lambda item: "{ name = " + item + " }"),
    ),
    max_leaves=3,
)
GOOD_LINES = GOOD.splitlines()
ASSIGNMENTS = [number for number, line in enumerate(GOOD_LINES) if " = " in line]


@given(st.sampled_from(ASSIGNMENTS), VALUES)
def test_any_value_is_accepted_or_reported_at_its_line(number, value):
    lines = GOOD_LINES.copy()
    lines[number] = lines[number].split(" = ")[0] + " = " + value
    error = mistake_in("\n".join(lines))
    event("refused" if error else "accepted")
    if error:
        assert len(str(error).splitlines()) == 1
        # A repeated node number is reported at the second node, a name where it is used.
        assert error.line >= number + 1
