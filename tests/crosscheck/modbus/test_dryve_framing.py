"""A dryve D1 behind the framing of pymodbus: its MBAP header, its transactions, its exceptions."""

import pytest
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from tests.support.dryve.bench import Bench


class ObjectTelegram(ModbusPDU):
    """Function 43 with MEI type 13, as bytes behind the function code."""

    function_code = 0x2B
    data = b""

    def __init__(self, data=b"", **ids):
        super().__init__(**ids)
        self.data = data

    def encode(self):
        return self.data

    def decode(self, data):
        self.data = data


@pytest.fixture
def ask():
    bench = Bench()
    decoder = DecodePDU(False)
    decoder.register(ObjectTelegram)
    framer = FramerSocket(decoder)

    def exchange(data, transaction=1, unit=0):
        request = ObjectTelegram(bytes.fromhex(data), transaction_id=transaction, dev_id=unit)
        answer = bench.ask(framer.buildFrame(request).hex())
        used, told = framer.handleFrame(bytes.fromhex(answer), unit, transaction)
        assert used == len(answer) // 2
        return told

    return exchange


@pytest.mark.parametrize(("transaction", "unit"), [(1, 0), (0x0F0F, 1), (0xFFFF, 255)])
def test_answer_is_decoded_with_its_transaction(ask, transaction, unit):
    told = ask("0D 00 00 00 60 41 00 00 00 00 02", transaction, unit)
    assert isinstance(told, ObjectTelegram)
    assert (told.transaction_id, told.dev_id) == (transaction, unit)
    assert told.data.hex() == "0d00000060410000000002" + "4006"


def test_write_is_answered_without_data(ask):
    told = ask("0D 01 00 00 60 60 00 00 00 00 01 06")
    assert told.data.hex() == "0d01000060600000000000"


def test_exception_is_decoded_with_its_code(ask):
    told = ask("0D 00 00 00 5F FF 00 00 00 00 02")
    assert isinstance(told, ExceptionResponse)
    assert (told.function_code, told.exception_code) == (0xAB, 2)
