"""EDS texts from the field: repaired with a warning, or refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.canopen.files.eds import EdsError, read_eds
from motorhil.emulators.canopen.object_dictionary import DataType
from tests.support.canopen.eds_texts import GOOD, line_of, variable, warned


def test_good_file_gives_objects_and_identity_without_warning(read):
    device = read(GOOD)
    assert warned(device) == []
    assert (device.vendor_name, device.product_name) == ("Somebody", "A drive")
    assert (device.vendor_number, device.product_number) == (0x123, 7)
    od = device.dictionary()
    assert od.integer(0x1000, 0, 0) == 0x20192
    assert od.dummies == (5,)
    assert od.integer(0x1018, 1, 0) == 0x123  # 1018h does not state it: [DeviceInfo] does
    assert od.get(0x1018, 1).name == "Vendor-ID"
    assert device.dictionary().get(0x1000) is not od.get(0x1000)


def test_dcf_for_other_node_gives_warning(read):
    whole = GOOD + "\n[DeviceComissioning]\nNodeID=3\n"
    ((line, text),) = warned(read(whole))
    assert line == line_of(whole, "NodeID=3")
    assert text == "written for node 3, used for 5; no COB-ID follows"
    assert warned(read(whole, node_id=3)) == []


DCF = """
[DeviceComissioning]
NodeID=3
[1014]
ParameterName=COB-ID EMCY
DataType=0x0007
AccessType=rw
ParameterValue=0x83
[1400]
ParameterName=RPDO
ObjectType=0x9
SubNumber=2
[1400sub0]
ParameterName=n
DataType=0x0005
AccessType=ro
DefaultValue=1
[1400sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x200
ParameterValue=0x203
[1800]
ParameterName=TPDO
ObjectType=0x9
SubNumber=2
[1800sub0]
ParameterName=n
DataType=0x0005
AccessType=ro
DefaultValue=1
[1800sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
ParameterValue=0x40000183
"""


def test_cob_ids_of_a_dcf_follow_the_node_id(read):
    """Compare with what $NODEID+80h, +200h and +40000180h give (CiA 301, 7.3.5; CiA 306)."""
    whole = GOOD + DCF
    places = ((0x1014, 0), (0x1400, 1), (0x1800, 1))
    for node_id, cob_ids in ((3, (0x83, 0x203, 0x40000183)), (127, (0xFF, 0x27F, 0x400001FF))):
        od = read(whole, node_id).dictionary()
        assert tuple(od.integer(*place, 0) for place in places) == cob_ids
    assert all(od.get(*place).follows_node_id for place in places)
    ((_, text),) = warned(read(whole, 127))
    assert text == (
        "written for node 3, used for 127; COB-IDs follow: 1014h:00h, 1400h:01h, 1800h:01h"
    )
    assert warned(read(whole, 3)) == []


@pytest.mark.parametrize(("old", "new"), [("0x40000183", "0x1F0"), ("0x83", "0x84")])
def test_dcf_with_a_fixed_sender_is_for_one_node(read, refused, old, new):
    whole = GOOD + DCF.replace(f"={old}", f"={new}")
    _, text = refused(whole)
    assert f"is {int(new, 16):03X}h, which does not follow the node-ID: written for node 3" in text
    assert warned(read(whole, 3)) == []


def test_cob_ids_shared_by_nodes_of_a_dcf_stay(read):
    shared_rpdo = GOOD + DCF.replace("ParameterValue=0x203", "ParameterValue=0x1F0")
    assert read(shared_rpdo).dictionary().integer(0x1400, 1, 0) == 0x1F0
    invalid = GOOD + DCF.replace("0x40000183", "0x80000000")
    assert read(invalid).dictionary().integer(0x1800, 1, 0) == 0x8000_0000


def test_windows_1252_text_gives_warning(read):
    whole = GOOD.replace("A drive", "M\x94ller\xb0").encode("latin-1")
    device = read(whole)
    assert device.product_name == "M\u201dller°"
    ((line, text),) = warned(device)
    assert line == 4
    assert "94h" in text


def test_utf_16_and_byte_order_mark_are_read(read):
    assert read(GOOD.encode("utf-16")).product_name == "A drive"
    assert read(b"\xef\xbb\xbf" + GOOD.encode()).product_name == "A drive"


@pytest.mark.parametrize("ends", ["\r\n", "\r"])
def test_line_ends_of_any_kind_are_read(read, ends):
    whole = (GOOD + variable("DefaultValue=5 ; x")).replace("\n", ends)
    device = read(whole)
    assert device.dictionary().get(0x6060).value == 5
    assert warned(device)[0][0] == line_of(GOOD + variable("DefaultValue=5 ; x"), "DefaultValue=5")


def test_case_and_spaces_of_names_are_ignored(read):
    text = "\n[ 6060 Sub 0A ]\nPARAMETERNAME=x\ndatatype = 0x2\naccessTYPE = RWW\n"
    device = read(GOOD + "\n[6060]\nobjecttype=9\n[6060SUB0]\nDataType=5\nAccessType=RO\n" + text)
    assert device.dictionary().get(0x6060, 0x0A).access == "rww"
    assert warned(device) == []


def test_comment_lines_give_no_warning(read):
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
def test_stray_lines_give_warning(read, line, words):
    whole = GOOD + variable(line) + "DataType=0x0002\nAccessType=rww\n"
    warnings = warned(read(whole))
    assert warnings[0][0] == line_of(whole, line)
    assert words in warnings[0][1]


def test_repeated_key_warns_if_equal_and_is_refused_otherwise(read, refused):
    whole = GOOD + variable("DefaultValue=5\nDefaultValue=5")
    ((line, text),) = warned(read(whole))
    assert line == line_of(whole, "DefaultValue=5") + 1
    assert "again" in text
    whole = GOOD + variable("DefaultValue=5\nDefaultValue=6")
    line, text = refused(whole)
    assert line == line_of(whole, "DefaultValue=6")
    assert "DefaultValue" in text
    assert str(line_of(whole, "DefaultValue=5")) in text


def test_repeated_unused_key_gives_warning(read):
    whole = GOOD.replace("VendorName=Somebody", "NrOfRXPDO=4\nNrOfRXPDO=3\nVendorName=Somebody")
    ((line, _),) = warned(read(whole))
    assert line == 3


def test_repeated_section_is_joined(read, refused):
    again = "\n[6060]\nDefaultValue=5\n"
    device = read(GOOD + variable("") + again)
    assert device.dictionary().get(0x6060).value == 5
    assert "again" in warned(device)[0][1]
    line, _ = refused(GOOD + variable("DefaultValue=6") + again)
    assert line == line_of(GOOD + variable("DefaultValue=6") + again, "DefaultValue=5")


MERGE = "<<<<<<< HEAD\n{}\n=======\n{}\n>>>>>>> 1234567\n"


def test_merge_with_equal_sides_is_read(read):
    sides = MERGE.format("; mine\nDefaultValue=5", "ParameterName=New name\ndefaultvalue = 5 ;x")
    whole = GOOD + variable(sides)
    device = read(whole)
    assert device.dictionary().get(0x6060).value == 5
    ((line, text),) = warned(device)
    assert line == line_of(whole, "<<<<<<<")
    assert "merge" in text


def test_merge_of_counts_and_lists_keeps_first_side(read):
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
def test_merge_with_different_sides_is_refused(refused, first, second):
    whole = GOOD + variable(MERGE.format(first, second))
    line, text = refused(whole)
    assert line == line_of(whole, "<<<<<<<")
    assert "merge" in text


def test_merge_with_common_ancestor_is_read(read):
    sides = (
        "<<<<<<< a\nDefaultValue=5\n||||||| b\nDefaultValue=4\n=======\nDefaultValue=5\n>>>>>>> c"
    )
    assert read(GOOD + variable(sides)).dictionary().get(0x6060).value == 5


@pytest.mark.parametrize("marker", ["<<<<<<< HEAD", "=======", ">>>>>>> 1234567"])
def test_incomplete_merge_is_refused(refused, marker):
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
def test_wrong_counts_and_lists_give_warning(read, old, new, where):
    whole = GOOD.replace(old, new)
    device = read(whole)
    assert len(device.objects) == 3
    assert [line for line, _ in warned(device)] == [line_of(whole, where)]


def test_missing_sub_index_0_is_added(read):
    whole = GOOD + "\n[60C2]\nObjectType=8\n[60C2sub2]\nDataType=2\nAccessType=rw\n"
    device = read(whole)
    assert device.dictionary().integer(0x60C2, 0, 0) == 2
    assert [line for line, _ in warned(device)] == [line_of(whole, "[60C2]")]


def test_sub_indices_without_object_section_are_read(read):
    whole = GOOD + "\n[60C2sub0]\nDataType=5\nAccessType=ro\nDefaultValue=0\n"
    device = read(whole)
    assert device.dictionary().get(0x60C2, 0).data_type == DataType.UNSIGNED8
    assert [line for line, _ in warned(device)] == [line_of(whole, "[60C2sub0]")]


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"just words\n", b"[FileInfo]\nx=1\n", b"\x7fELF\x02\x01\x00\x00"]
)
def test_other_file_is_refused_as_eds(refused, content):
    refused(content)


def test_missing_file_or_folder_is_refused(tmp_path):
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
def test_random_lines_are_read_or_refused_in_one_line(tmp_path_factory, lines):
    path = tmp_path_factory.getbasetemp() / "any.eds"
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    message = ""
    try:
        read_eds(path, 1).dictionary()
    except EdsError as error:
        message = str(error)
    assert "\n" not in message


def test_value_with_a_long_gap_is_refused_in_short(read):
    """Before, a search for a comment began again at each of the blanks."""
    with pytest.raises(EdsError) as caught:
        read(GOOD.replace("ProductNumber=7", "ProductNumber=7" + " " * 300_000 + "7"))
    assert len(str(caught.value)) < 300
