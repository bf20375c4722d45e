"""EDS texts that people really have: repaired with a warning that names the line, or refused."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulators.canopen.eds import EdsError, read_eds
from emulators.canopen.object_dictionary import DataType

GOOD = """\
[DeviceInfo]
VendorName=Somebody
VendorNumber=0x123
ProductName=A drive
ProductNumber=7
RevisionNumber=0x10002

[DummyUsage]
Dummy0005=1
Dummy0006=0

[MandatoryObjects]
SupportedObjects=2
1=0x1000
2=0x1018

[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0

[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2

[1018sub0]
ParameterName=Number of entries
DataType=0x0005
AccessType=ro
DefaultValue=1

[1018sub1]
ParameterName=Vendor-ID
DataType=0x0007
AccessType=ro
"""


def variable(text: str, sub: str = "") -> str:
    return f"\n[6060{sub}]\nParameterName=Modes\nDataType=0x0002\nAccessType=rww\n{text}\n"


@pytest.fixture
def read(tmp_path: Path):
    def reader(text: str | bytes, node_id: int = 5):
        path = tmp_path / "drive.eds"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_eds(path, node_id)

    return reader


@pytest.fixture
def refused(read):
    def reader(text: str | bytes) -> tuple[int, str]:
        with pytest.raises(EdsError) as caught:
            read(text)
        error = caught.value
        message = str(error)
        assert "\n" not in message
        assert message.startswith(f"{error.path}:{error.line}: " if error.line else str(error.path))
        assert error.remedy
        assert message.endswith(error.remedy)
        return error.line, error.text

    return reader


def warned(description) -> list[tuple[int, str]]:
    assert all(path == description.path for path, _, _ in description.warnings)
    return [(line, text) for _, line, text in description.warnings]


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


def test_a_good_file_gives_objects_identity_and_no_warning(read):
    device = read(GOOD)
    assert warned(device) == []
    assert (device.vendor_name, device.product_name) == ("Somebody", "A drive")
    assert (device.vendor_number, device.product_number) == (0x123, 7)
    od = device.dictionary()
    assert od.integer(0x1000, 0, 0) == 0x20192
    assert od.dummies == (5,)
    assert od.integer(0x1018, 1, 0) == 0x123  # 1018h states none: [DeviceInfo] does
    assert od.get(0x1018, 1).name == "Vendor-ID"
    assert device.dictionary().get(0x1000) is not od.get(0x1000)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0xFD", -3),  # hexadecimals of signed types are two's complement
        ("-3", -3),
        ("0x7F", 127),
        ("-0x03", -3),
        ("0x80", -128),
        ("$NODEID+0x10", 0x15),
        ("0x10+$NodeId", 0x15),
        ("$nodeid + 16", 0x15),
        ("$NODEID", 5),
        ("00", 0),
        ("  7  ", 7),
        ("", None),
    ],
)
def test_values_that_need_no_remark(read, text, value):
    device = read(GOOD + variable(f"DefaultValue={text}"))
    assert warned(device) == []
    entry = device.dictionary().get(0x6060)
    assert entry.value == (0 if value is None else value)
    assert entry.has_default == (value is not None)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0xFD ; two's complement", -3),
        ("5;five", 5),
        ("5 // five", 5),
        ("5 # five", 5),
        ("253", -3),  # decimal, yet plainly meant as two's complement
        ("0xFFFFFFFD", -3),  # written for 32 bits
        ("010", 8),  # CiA 306: octal
        ("08", 8),
        ("10h", 16),
        ('"5"', 5),
        ("5.0", 5),
        ("true", 1),
        ("$NODEID+1 ; mine", 6),
    ],
)
def test_values_that_are_plain_after_a_repair(read, text, value):
    whole = GOOD + variable(f"DefaultValue={text}")
    device = read(whole)
    assert device.dictionary().get(0x6060).value == value
    assert [line for line, _ in warned(device)] == [line_of(whole, f"DefaultValue={text}")]


@pytest.mark.parametrize("text", ["five", "0xZ", "300", "0x1FF", "-129", "$NODEID*2", "1 2", "5.5"])
def test_a_value_that_nobody_can_read_is_refused_with_its_line(refused, text):
    whole = GOOD + variable(f"DefaultValue={text}")
    line, _ = refused(whole)
    assert line == line_of(whole, f"DefaultValue={text}")


def test_limits_are_two_s_complement_too(read):
    device = read(GOOD + variable("LowLimit=0x80\nHighLimit=0x7F\nDefaultValue=-128"))
    entry = device.dictionary().get(0x6060)
    assert (entry.low, entry.high) == (-128, 127)
    assert warned(device) == []


@pytest.mark.parametrize(
    ("limits", "expected", "words"),
    [
        ("LowLimit=0\nHighLimit=0xFF\nDefaultValue=0", (None, None), "leave no value"),
        ("LowLimit=0\nHighLimit=0\nDefaultValue=6", (None, None), "left out"),
        ("LowLimit=0\nHighLimit=9\nDefaultValue=10", (0, 9), "outside"),
        ("LowLimit=none\nHighLimit=9", (None, 9), "left out"),
        ("LowLimit=-1000\nHighLimit=9", (None, 9), "left out"),
    ],
)
def test_limits_that_make_no_sense_are_left_out_with_a_warning(read, limits, expected, words):
    whole = GOOD + variable(limits)
    device = read(whole)
    entry = device.dictionary().get(0x6060)
    assert (entry.low, entry.high) == expected
    ((line, text),) = warned(device)
    assert line == line_of(whole, "LowLimit")
    assert words in text


def test_in_a_dcf_the_parameter_value_wins_over_the_default_value(read):
    device = read(GOOD + variable("DefaultValue=8\nParameterValue=50"))
    assert device.dictionary().get(0x6060).default == 50
    device = read(GOOD + variable("ParameterValue=\nDefaultValue=8"))
    assert device.dictionary().get(0x6060).default == 8


def test_a_dcf_written_for_another_node_is_told(read):
    whole = GOOD + "\n[DeviceComissioning]\nNodeID=3\n"
    ((line, text),) = warned(read(whole))
    assert line == line_of(whole, "NodeID=3")
    assert "node 3" in text
    assert warned(read(whole, node_id=3)) == []


def test_windows_1252_text_is_read_and_told(read):
    whole = GOOD.replace("A drive", "M\x94ller\xb0").encode("latin-1")
    device = read(whole)
    assert device.product_name == "M\u201dller°"
    ((line, text),) = warned(device)
    assert line == 4
    assert "94h" in text


def test_utf_16_and_a_byte_order_mark_are_read(read):
    assert read(GOOD.encode("utf-16")).product_name == "A drive"
    assert read(b"\xef\xbb\xbf" + GOOD.encode()).product_name == "A drive"


@pytest.mark.parametrize("ends", ["\r\n", "\r"])
def test_any_line_ends_do(read, ends):
    whole = (GOOD + variable("DefaultValue=5 ; x")).replace("\n", ends)
    device = read(whole)
    assert device.dictionary().get(0x6060).value == 5
    assert warned(device)[0][0] == line_of(GOOD + variable("DefaultValue=5 ; x"), "DefaultValue=5")


def test_case_and_spaces_of_sections_and_keys_do_not_matter(read):
    text = "\n[ 6060 Sub 0A ]\nPARAMETERNAME=x\ndatatype = 0x2\naccessTYPE = RWW\n"
    device = read(GOOD + "\n[6060]\nobjecttype=9\n[6060SUB0]\nDataType=5\nAccessType=RO\n" + text)
    assert device.dictionary().get(0x6060, 0x0A).access == "rww"
    assert warned(device) == []


def test_comments_on_their_own_lines_are_silent(read):
    assert warned(read("; first\n;\n" + GOOD + "\n   ; last")) == []


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("# a comment", "comment"),
        ("// a comment", "comment"),
        ("not a thing", "left out"),
        ("[6061", "closing bracket"),
        ("[6061] DataType", "behind the section name"),
    ],
)
def test_stray_lines_are_told(read, line, words):
    whole = GOOD + variable(line) + "DataType=0x0002\nAccessType=rww\n"
    warnings = warned(read(whole))
    assert warnings[0][0] == line_of(whole, line)
    assert words in warnings[0][1]


def test_a_key_twice_with_one_meaning_is_told_with_two_it_is_refused(read, refused):
    whole = GOOD + variable("DefaultValue=5\nDefaultValue=5")
    ((line, text),) = warned(read(whole))
    assert line == line_of(whole, "DefaultValue=5") + 1
    assert "again" in text
    whole = GOOD + variable("DefaultValue=5\nDefaultValue=6")
    line, text = refused(whole)
    assert line == line_of(whole, "DefaultValue=6")
    assert "DefaultValue" in text
    assert str(line_of(whole, "DefaultValue=5")) in text


def test_a_key_twice_that_nobody_uses_is_told(read):
    whole = GOOD.replace("VendorName=Somebody", "NrOfRXPDO=4\nNrOfRXPDO=3\nVendorName=Somebody")
    ((line, _),) = warned(read(whole))
    assert line == 3


def test_a_section_twice_is_one_section(read, refused):
    again = "\n[6060]\nDefaultValue=5\n"
    device = read(GOOD + variable("") + again)
    assert device.dictionary().get(0x6060).value == 5
    assert "again" in warned(device)[0][1]
    line, _ = refused(GOOD + variable("DefaultValue=6") + again)
    assert line == line_of(GOOD + variable("DefaultValue=6") + again, "DefaultValue=5")


MERGE = "<<<<<<< HEAD\n{}\n=======\n{}\n>>>>>>> 1234567\n"


def test_an_unresolved_merge_whose_sides_mean_the_same_is_read(read):
    sides = MERGE.format("; mine\nDefaultValue=5", "ParameterName=New name\ndefaultvalue = 5 ;x")
    whole = GOOD + variable(sides)
    device = read(whole)
    assert device.dictionary().get(0x6060).value == 5
    ((line, text),) = warned(device)
    assert line == line_of(whole, "<<<<<<<")
    assert "merge" in text


def test_an_unresolved_merge_about_counts_and_lists_keeps_the_first_side(read):
    whole = GOOD.replace("2=0x1018\n", MERGE.format("2=0x1018", "2=0x1018\n3=0x1019"))
    assert [line for line, _ in warned(read(whole))] == [line_of(whole, "<<<<<<<")]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("DefaultValue=5", "DefaultValue=6"),
        ("DefaultValue=5", ""),
        ("DefaultValue=5", "[6061]\nDefaultValue=5"),
        ("", "[6061]"),
    ],
)
def test_an_unresolved_merge_whose_sides_differ_is_refused(refused, first, second):
    whole = GOOD + variable(MERGE.format(first, second))
    line, text = refused(whole)
    assert line == line_of(whole, "<<<<<<<")
    assert "merge" in text


def test_a_merge_with_the_common_ancestor_shown_is_understood(read):
    sides = (
        "<<<<<<< a\nDefaultValue=5\n||||||| b\nDefaultValue=4\n=======\nDefaultValue=5\n>>>>>>> c"
    )
    assert read(GOOD + variable(sides)).dictionary().get(0x6060).value == 5


@pytest.mark.parametrize("marker", ["<<<<<<< HEAD", "=======", ">>>>>>> 1234567"])
def test_half_a_merge_is_refused(refused, marker):
    whole = GOOD + variable(marker)
    assert refused(whole)[0] == line_of(whole, marker)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("SupportedObjects=2", "SupportedObjects=5", "SupportedObjects=5"),
        ("2=0x1018", "2=0x1019", "2=0x1019"),
        ("SubNumber=2", "SubNumber=4", "SubNumber=4"),
    ],
)
def test_wrong_counts_and_lists_are_told_and_the_sections_count(read, old, new, where):
    whole = GOOD.replace(old, new)
    device = read(whole)
    assert len(device.objects) == 3
    assert [line for line, _ in warned(device)] == [line_of(whole, where)]


def test_sub_index_0_is_made_up_where_it_lacks(read):
    whole = GOOD + "\n[60C2]\nObjectType=8\n[60C2sub2]\nDataType=2\nAccessType=rw\n"
    device = read(whole)
    assert device.dictionary().integer(0x60C2, 0, 0) == 2
    assert [line for line, _ in warned(device)] == [line_of(whole, "[60C2]")]


def test_sub_indices_without_their_object_are_read(read):
    whole = GOOD + "\n[60C2sub0]\nDataType=5\nAccessType=ro\nDefaultValue=0\n"
    device = read(whole)
    assert device.dictionary().get(0x60C2, 0).data_type == DataType.UNSIGNED8
    assert [line for line, _ in warned(device)] == [line_of(whole, "[60C2sub0]")]


def test_compact_sub_objects_are_written_out(read):
    text = """
[1016]
ParameterName=Consumer heartbeat time
ObjectType=0x8
DataType=0x0007
AccessType=rw
DefaultValue=0
CompactSubObj=3
[1016Name]
NrOfEntries=1
2=The host
[1016Value]
NrOfEntries=1
2=0x007F0096
"""
    device = read(GOOD + text)
    assert warned(device) == []
    od = device.dictionary()
    assert [od.integer(0x1016, sub, 9) for sub in range(4)] == [3, 0, 0x7F0096, 0]
    assert od.get(0x1016, 2).name == "The host"
    assert od.get(0x1016, 0).access == "ro"
    assert od.get(0x1016, 4) is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("DataType=0x0002\n", ""),
        ("AccessType=rww", "AccessType=sometimes"),
        ("DataType=0x0002", "DataType=seven"),
    ],
)
def test_an_object_that_cannot_be_made_is_refused(refused, old, new):
    whole = GOOD + variable("").replace(old, new)
    line, _ = refused(whole)
    assert line == line_of(whole, new or "[6060]")


@pytest.mark.parametrize(
    ("old", "new", "access"),
    [
        ("AccessType=rww\n", "", "rw"),
        ("AccessType=rww", "AccessType=read-only", "ro"),
        ("AccessType=rww", "AccessType=R/W", "rw"),
    ],
)
def test_access_in_other_words_is_told(read, old, new, access):
    device = read(GOOD + variable("").replace(old, new))
    assert device.dictionary().get(0x6060).access == access
    assert len(warned(device)) == 1


def test_an_unknown_data_type_is_a_domain(read):
    device = read(GOOD + variable("").replace("DataType=0x0002", "DataType=0x0040"))
    assert device.dictionary().get(0x6060).data_type == DataType.DOMAIN
    assert len(warned(device)) == 1


@pytest.mark.parametrize(
    ("data_type", "text", "value"),
    [
        (0x08, "1.5", 1.5),
        (0x08, "0", 0.0),
        (0x09, "C5-E 2; Rev #1", b"C5-E 2; Rev #1"),
        (0x0A, "0102FF", b"\x01\x02\xff"),
        (0x0F, "01 02", b"\x01\x02"),
        (0x01, "1", 1),
        (0x15, "0xFFFFFFFFFFFFFFFF", -1),
    ],
)
def test_values_of_other_types(read, data_type, text, value):
    whole = variable(f"DefaultValue={text}").replace("0x0002", f"0x{data_type:04X}")
    device = read(GOOD + whole)
    assert device.dictionary().get(0x6060).value == value
    assert warned(device) == []


@pytest.mark.parametrize(
    ("data_type", "text", "value"),
    [(0x08, "1,5", 1.5), (0x08, "0x3FC00000", 1.5), (0x05, "-1", 255), (0x0F, "xy", b"xy")],
)
def test_values_of_other_types_after_a_repair(read, data_type, text, value):
    whole = variable(f"DefaultValue={text}").replace("0x0002", f"0x{data_type:04X}")
    device = read(GOOD + whole)
    assert device.dictionary().get(0x6060).value == value
    assert len(warned(device)) == 1


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"just words\n", b"[FileInfo]\nx=1\n", b"\x7fELF\x02\x01\x00\x00"]
)
def test_what_is_no_eds_is_refused(refused, content):
    refused(content)


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    for path in (tmp_path / "none.eds", tmp_path):
        with pytest.raises(EdsError, match="cannot be read") as caught:
            read_eds(path, 1)
        assert caught.value.line == 0


LINES = st.sampled_from(
    [
        *GOOD.splitlines(),
        *variable("DefaultValue=0xFD\nLowLimit=0x80").splitlines(),
        *MERGE.format("DefaultValue=5", "CompactSubObj=3").splitlines(),
        "[6060sub1]",
        "CompactSubObj=300",
        "ObjectType=8",
        "[A0sub1]",
        "DataType=0xA0",
        "SubNumber=x",
        "[",
        "=",
        "[]",
        "[6060Value]",
        "1=",
    ]
)


@given(st.lists(LINES | st.text(max_size=12), max_size=40))
def test_any_lines_are_read_or_refused_in_one_line(tmp_path_factory, lines):
    path = tmp_path_factory.getbasetemp() / "any.eds"
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    message = ""
    try:
        read_eds(path, 1).dictionary()
    except EdsError as error:
        message = str(error)
    assert "\n" not in message
