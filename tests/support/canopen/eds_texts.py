"""A small EDS to modify, and the places of warnings."""

from motorhil.emulators.canopen.files.device_description import DeviceDescription

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


def warned(description: DeviceDescription) -> list[tuple[int, str]]:
    assert all(path == description.path for path, _, _ in description.warnings)
    return [(line, text) for _, line, text in description.warnings]


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1
