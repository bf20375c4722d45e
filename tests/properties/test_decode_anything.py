"""The decoders describe any bytes without failing."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.decoding.objects import ObjectNames
from motorhil.traces.formats.modbus import Adu, adu_of

# Mostly identifiers of one node's services; bytes that begin like SDOs and PDO parameters.
SERVICES = [0, 0x80, 0x81, 0x100, 0x181, 0x201, 0x281, 0x581, 0x601, 0x701]
FIRST = [0x00, 0x10, 0x20, 0x23, 0x2F, 0x40, 0x41, 0x43, 0x4F, 0x60, 0x80, 0xA0, 0xC0, 0xC2]
OBJECTS = [0x1800, 0x1A00, 0x1A00, 0x1400, 0x1600, 0x6040, 0x6041, 0x6060, 0x1008, 0x2000]
SDO = st.builds(
    lambda first, index, sub, value: struct.pack("<BHBI", first, index, sub, value),
    *(st.sampled_from(FIRST) | st.integers(0, 255), st.sampled_from(OBJECTS)),
    *(st.integers(0, 3), st.sampled_from([0, 1, 2, 0x60410010, 0x181]) | st.integers(0, 2**32 - 1)),
)
FRAMES = st.tuples(
    st.sampled_from(SERVICES) | st.integers(0, 2**32 - 1), SDO | st.binary(max_size=8)
)
PDUS = st.binary(max_size=12) | st.builds(
    lambda function, rest: bytes((function, *rest)), st.integers(1, 24), st.binary(max_size=12)
)


@given(st.lists(FRAMES, max_size=40))
def test_any_frames_are_decoded(frames):
    decoder = CanopenDecoder()
    for identifier, data in frames:
        said = decoder.decode(struct.pack("<IB3x8s", identifier, len(data), data))
        assert said.text
        assert all(fact.subject and fact.text for fact in said.facts)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2), PDUS), max_size=20))
def test_any_adus_are_decoded(adus):
    decoder = ModbusDecoder()
    for to_server, unit, pdu in adus:
        assert decoder.decode(Adu(0, None, to_server, 0, unit, pdu)).text


@given(st.binary(max_size=20), st.booleans())
def test_any_line_bytes_are_adu_or_problem(data, tcp):
    adu = adu_of(0, data, tcp=tcp, to_server=True)
    assert isinstance(adu, Adu) or adu.problem


@given(st.text(alphabet="[]1A00sub=0x$NODEID+;\n PDdefaultValue", max_size=200))
def test_any_eds_is_read(text):
    CanopenDecoder(objects={1: ObjectNames(text)})
