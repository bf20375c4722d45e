"""Arbitrary answers and failing buses raise only errors of the tree."""

import gc
import random
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress

import can
import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation, SdoAborted
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorError, UsageError
from motorhil.motorapi.model import MotorModel
from tests.support.motors.scripted import MS, Answer, ScriptedBus, Transcript, frame

MODEL = MotorModel(name="m", velocity_max=1.0, acceleration_max=1.0)
OPTIONS = HwOptions(connect_timeout_s=0.3, sdo_timeout_s=0.05, sdo_quarantine_s=0.1)
HEARD = (0x585, 0x585, 0x585, 0x185, 0x085, 0x705)  # SDO, TPDO 1, EMCY, heartbeat of node 5
COMMANDS = (0x40, 0x41, 0x43, 0x4F, 0x60, 0x80, 0x00, 0x01, 0x10, 0x11, 0x20, 0x30, 0xA0, 0xC2)


def garbage(seed: int) -> Callable[[bytes], Iterable[Answer]]:
    """Return a device that answers SDO requests by frames like answers, of any length."""
    draw = random.Random(seed)

    def answer(request: bytes) -> Iterable[Answer]:
        if request[:2] != b"\x05\x06":
            return
        for _ in range(draw.randint(0, 3)):
            command = draw.choice((*COMMANDS, draw.randrange(256)))
            place = request[9:12] if draw.random() < 0.8 else draw.randbytes(3)
            data = (bytes((command,)) + place + draw.randbytes(4))[
                : draw.choice((0, 1, 4, 7, 8, 8))
            ]
            delay_ns = draw.choice((MS // 10, MS, 120 * MS))
            yield delay_ns, frame(f"{draw.choice(HEARD):03X}#{data.hex()}")

    return answer


def block_upload(hardware: Cia402HwMotor) -> None:
    with hardware.sdo() as sdo:
        sdo.open(0x1008, block_transfer=True).read()


def block_download(hardware: Cia402HwMotor) -> None:
    with (
        hardware.sdo() as sdo,
        sdo.open(0x1008, mode="wb", block_transfer=True, size=20) as stream,
    ):
        stream.write(bytes(20))


def calls_of(hardware: Cia402HwMotor, motor: Cia402Motor) -> list[Callable[[], object]]:
    return [
        lambda: hardware.read("statusword"),
        lambda: hardware.read("manufacturer_device_name"),
        lambda: hardware.upload(0x1008),
        lambda: hardware.write(0x6065, 5),
        lambda: hardware.download(0x2000, 0, bytes(20)),
        lambda: block_upload(hardware),
        lambda: block_download(hardware),
        hardware.enable,
        motor.state,
        motor.position,
        motor.enable,
        motor.stop,
        motor.reset_fault,
        lambda: motor.home(37, timeout_s=0.2),
    ]


@given(st.integers(0, 10**6), st.permutations(range(14)))
@example(seed=1, order=list(range(14)))
def test_garbage_of_a_device_raises_a_peer_error(seed: int, order: list[int]):
    hardware = Cia402HwMotor(ScriptedBus(garbage(seed)), 5, options=OPTIONS)
    motor = Cia402Motor(hardware, MODEL)
    calls = calls_of(hardware, motor)
    try:
        for place in order:
            try:
                calls[place]()
            except MotorError as error:
                event(type(error).__name__)
            repr(motor), repr(hardware), motor.latest()
    finally:
        hardware.close()


def test_canopen_errors_in_a_block_become_ours():
    bus = ScriptedBus(
        Transcript(
            [
                ("605#4008100000000000", "585#8008100000000206"),  # CiA 301: object does not exist
                ("605#4009100000000000", None),
                ("605#400A100000000000", "585#60EEEE0000000000"),
            ]
        )
    )
    hardware = Cia402HwMotor(bus, 5, options=OPTIONS)
    with pytest.raises(SdoAborted) as aborted, hardware.sdo() as sdo:
        sdo.upload(0x1008, 0)
    assert (aborted.value.index, aborted.value.abort_code) == (0x1008, 0x06020000)
    with pytest.raises(DeadlineExceeded, match="SDO 1009h:00h"), hardware.sdo() as sdo:
        sdo.upload(0x1009, 0)
    with pytest.raises(DeadlineExceeded, match="last heard: 60 EE EE"), hardware.sdo() as sdo:
        sdo.upload(0x100A, 0)
    with pytest.raises(ZeroDivisionError), hardware.sdo():
        raise ZeroDivisionError  # the application's own errors are unchanged
    hardware.close()


BREAKS = (
    can.CanOperationError("bus off"),
    can.CanInitializationError("no such device"),
    can.CanTimeoutError("transmit buffer full"),
    OSError(100, "Network is down"),
    BrokenPipeError(32, "Broken pipe"),
)


@pytest.mark.parametrize("error", BREAKS, ids=lambda error: type(error).__name__)
def test_failing_bus_raises_link_error(error: Exception):
    class Broken(ScriptedBus):
        def transmit(self, data: bytes) -> None:
            raise error

    bus = Broken()
    # Without a heartbeat of the host, whose frames would fail first.
    options = HwOptions(heartbeat_ms=0, connect_timeout_s=0.3, sdo_timeout_s=0.05)
    hardware = Cia402HwMotor(bus, 5, options=options)
    motor = Cia402Motor(hardware, MODEL)
    for call in calls_of(hardware, motor):
        if call in (motor.state, motor.stop):
            continue
        with pytest.raises(LinkError) as caught:
            call()
        assert caught.value.__cause__ is error
        assert "cannot send" in caught.value.reason
    with pytest.raises(LinkError):
        hardware.send_frame(0x605, bytes(8))
    hardware.close()


SLIPS: list[Callable[[Cia402HwMotor], object]] = [
    lambda hw: hw.read("statuswort"),
    lambda hw: hw.read(None),  # type: ignore[arg-type]
    lambda hw: hw.read(0x12345),
    lambda hw: hw.read(-1),
    lambda hw: hw.read(0x6041, 256),
    lambda hw: hw.read(0x6041, "1"),  # type: ignore[arg-type]
    lambda hw: hw.read(0x2345, kind="u7"),
    lambda hw: hw.upload("statusword"),  # type: ignore[arg-type]
    lambda hw: hw.upload(0x6041, 1000),
    lambda hw: hw.download(0x6065, 0, 5),  # type: ignore[arg-type]
    lambda hw: hw.download(0x6065, 0, None),  # type: ignore[arg-type]
    lambda hw: hw.write(0x6065, -1),
    lambda hw: hw.write(0x6065, 1.5),
    lambda hw: hw.write(0x2345, 1),
    lambda hw: hw.write(0x2345, 1, kind="x"),
    lambda hw: hw.write(0x2345, 1e308, kind="f32"),
    lambda hw: hw.write([], 1),  # type: ignore[arg-type]
    lambda hw: hw.set_mode(99),  # type: ignore[arg-type]
    lambda hw: hw.set_mode("pp"),  # type: ignore[arg-type]
    lambda hw: Cia402HwMotor(None, 5),  # type: ignore[arg-type]
    lambda hw: Cia402HwMotor("can0", 5),  # type: ignore[arg-type]
    lambda hw: Cia402Motor(hw, None),  # type: ignore[arg-type]
    lambda hw: Cia402Motor(MODEL, hw),  # type: ignore[arg-type]
]


@pytest.mark.parametrize("slip", SLIPS)
def test_wrong_argument_at_the_prompt_is_refused(
    slip: Callable[[Cia402HwMotor], object],
):
    bus = ScriptedBus()
    hardware = Cia402HwMotor(bus, 5, options=OPTIONS)
    with pytest.raises(UsageError) as caught:
        slip(hardware)
    assert str(caught.value)
    assert bus.sent == []
    with suppress(MotorError):
        hardware.close()


def test_missing_bytes_of_an_answer_are_not_made_up():
    def peer(request: bytes) -> Iterable[Answer]:
        if request[8:12] == b"\x40\x00\x10\x00":
            yield MS, frame("585#4B00100092010000")  # 2 of the 4 bytes of 1000h

    with pytest.raises(ProtocolViolation) as caught:
        Cia402HwMotor(ScriptedBus(peer), 5, options=OPTIONS).connect()
    assert str(caught.value) == (
        "node 5: SDO 1000h:00h: 2 bytes (92 01) for the data type u32, of 4"
    )


@pytest.mark.parametrize(
    "answers",
    [
        [("605#2100200014000000", None)],
        [
            ("605#2100200014000000", "585#6000200000000000"),
            ("605#0000000000000000", "585#8000200000000008"),  # CiA 301: general error
        ],
    ],
)
def test_failed_download_sends_nothing_when_collected(answers, monkeypatch):
    ignored = []
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    bus = ScriptedBus(Transcript(answers))
    hardware = Cia402HwMotor(bus, 5, options=OPTIONS)
    with suppress(MotorError):
        hardware.download(0x2000, 0, bytes(20))
    gc.collect()
    ends = [text for text in bus.texts if text.startswith(("605#0F", "605#1F"))]  # without data
    assert (ends, ignored) == ([], [])
    hardware.close()
