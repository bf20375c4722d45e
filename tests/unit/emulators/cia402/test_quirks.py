"""Each quirk on the wire: the difference between a drive with it and one without."""

import struct

import pytest

from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.cia402.drive import build
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.quirks import Around
from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.emulators.controller import ControllerContext
from tests.support.cia402.bench import BOOT_UP, MS, NODE, Bench, Path

ACKNOWLEDGE, REACHED = 0x1000, 0x0400


def quirky(*names: str, seed: int = 1, lss: bool = False, **table: object) -> Bench:
    """Return a bench with a quirky drive, with the parameters in `table` or the catalogue's."""
    quirks: dict[str, object] = {**dict.fromkeys(names, True), **table}
    settings = {"node_id": NODE, "quirks": quirks, "plant": {"preset": "wheel_60w"}}
    if lss:
        settings["node_id_by_lss"] = True
    drive = build(settings, ControllerContext(name="drive", folder=Path(), seed=seed))
    return Bench(drive)  # type: ignore[arg-type]  # it, or what stands around it


def word(bench: Bench) -> int:
    return int.from_bytes(bench.last(0x180 + NODE), "little")


def go(bench: Bench, target: int, controlword: int) -> None:
    """Offer a set-point, and withdraw it."""
    bench.set(0x607A, 0, target, 4)
    bench.controlword(controlword)
    bench.run(10 * MS)


def test_drive_without_quirks_has_no_wrapper():
    assert type(quirky().drive).__name__ == "Cia402Drive"
    position = quirky("single_set_point_only").drive
    assert type(position).__name__ == "Cia402Drive"
    assert type(quirky("slow_sdo").drive).__name__ == "QuirkyWire"
    assert type(quirky(slow_sdo=False).drive).__name__ == "Cia402Drive"


@pytest.mark.parametrize("name", [quirk.name for quirk in CATALOGUE])
def test_quirk_is_reported_in_the_recording(name):
    assert any(text.startswith(f"quirk {name}") for _, text in quirky(name).events)


def test_mode_wrapper_forwards_every_call():
    calls = {name for name, call in vars(Mode).items() if callable(call) and name != "__init__"}
    assert calls <= set(vars(Around))


def test_inverted_set_point_acknowledge_inverts_bit_12():
    """Check canopen-python/canopen issue 678: set once enabled, clear when bit 4 was set."""
    bench = quirky("inverted_set_point_acknowledge")
    bench.enable(mode=1)
    bench.run(20 * MS)
    assert word(bench) & ACKNOWLEDGE
    go(bench, 5000, 0x1F)
    assert not word(bench) & ACKNOWLEDGE
    bench.controlword(0x0F)
    bench.run(1000 * MS)
    assert word(bench) & (ACKNOWLEDGE | REACHED) == ACKNOWLEDGE | REACHED
    assert bench.read(0x6064) == pytest.approx(5000, abs=10)  # position window
    bench.controlword(0x06)
    bench.run(10 * MS)
    assert not word(bench) & ACKNOWLEDGE


def test_single_set_point_only_needs_bit_5():
    bench = quirky("single_set_point_only")
    bench.enable(mode=1)
    go(bench, 5000, 0x1F)
    assert not bench.statusword() & ACKNOWLEDGE
    bench.run(500 * MS)
    assert bench.read(0x6064) == 0
    bench.controlword(0x0F)
    go(bench, 5000, 0x3F)
    assert bench.statusword() & ACKNOWLEDGE
    bench.run(1000 * MS)
    assert bench.read(0x6064) == pytest.approx(5000, abs=10)


def test_edge_only_bits_must_have_been_0_before():
    """Check nasa-jpl/jsd issue 103: bits 4 and 5 must have been 0 before."""
    bench = quirky("edge_only_bits")
    bench.enable(mode=1)
    go(bench, 3000, 0x3F)
    assert bench.statusword() & ACKNOWLEDGE
    bench.run(1000 * MS)
    bench.controlword(0x2F)  # bit 5 left set
    go(bench, 6000, 0x3F)
    assert not bench.statusword() & ACKNOWLEDGE
    bench.run(1000 * MS)
    assert bench.read(0x6064) == pytest.approx(3000, abs=10)
    bench.controlword(0x0F)
    go(bench, 6000, 0x3F)
    bench.run(1000 * MS)
    assert bench.read(0x6064) == pytest.approx(6000, abs=10)
    bench.controlword(0x0F)
    go(bench, 3000, 0x1F)  # without bit 5, only bit 4 need rise
    assert bench.statusword() & ACKNOWLEDGE


def test_stale_target_reached_stays_for_its_time():
    bench = quirky(stale_target_reached={"for_s": 0.05})
    bench.enable(mode=1)
    go(bench, 3000, 0x3F)
    assert not bench.statusword() & REACHED  # nothing was reached before
    bench.run(1000 * MS)
    bench.controlword(0x0F)
    bench.run(20 * MS)
    bench.set(0x607A, 0, 60_000, 4)
    bench.controlword(0x3F)
    offered = bench.now
    bench.run_until(offered + 50 * MS - 1)
    assert word(bench) & (ACKNOWLEDGE | REACHED) == ACKNOWLEDGE | REACHED
    assert bench.read(0x6064) > 3020  # long under way
    bench.run_until(offered + 55 * MS)
    assert not word(bench) & REACHED
    assert offered + 50 * MS in bench.times(0x180 + NODE)
    bench.run(5000 * MS)
    assert word(bench) & REACHED


def test_halt_holds_mode_until_halt_ends():
    bench = quirky("halt_holds_mode")
    bench.enable(mode=1)
    bench.controlword(0x10F)
    assert bench.write(0x6060, 0, 3, 1) == OK
    bench.run(10 * MS)
    assert bench.read(0x6061) == 1
    bench.controlword(0x0F)
    bench.set(0x6060, 0, 3, 1)
    assert bench.read(0x6061) == 3


@pytest.mark.parametrize(
    ("names", "frame"),
    [
        (["stray_emcy"], (0x081, "1186210000000000")),
        (["misplaced_error_register"], (0x085, "1186002100000000")),
        (["stray_emcy", "misplaced_error_register"], (0x081, "1186002100000000")),
    ],
)
def test_nonstandard_emcy_has_the_expected_frame(names, frame):
    bench = quirky(*names)
    bench.operational()
    bench.drive.stimulate("fault", 0x8611, bench.now)
    bench._drain()
    assert [(can_id, data.hex()) for _, can_id, data in bench.sent if data[:2] == b"\x11\x86"] == [
        frame
    ]


def answers_ms(bench: Bench, count: int = 40) -> list[float]:
    """Return the duration of each SDO upload [ms]."""
    took = []
    for _ in range(count):
        asked = bench.now
        bench.read(0x6041)
        took.append((bench.now - asked) / MS)
    return took


def test_slow_sdo_delay_depends_on_the_seed():
    bench = quirky("slow_sdo")
    bench.boot()
    took = answers_ms(bench)
    assert min(took) >= 1 + 10  # 1 ms as in every drive; mean 20 ms, spread 10
    assert max(took) <= 1 + 30
    assert max(took) - min(took) > 10
    same, other = quirky("slow_sdo"), quirky("slow_sdo", seed=2)
    same.boot()
    other.boot()
    assert answers_ms(same) == took
    assert answers_ms(other) != took


def test_slow_sdo_replies_keep_order_and_block_nothing():
    bench = quirky(slow_sdo={"mean_s": 0.05, "spread_s": 0.05})
    bench.operational()
    for index in (0x1000, 0x1001, 0x1018, 0x6041, 0x6060):
        bench.send(0x600 + NODE, struct.pack("<BHB4x", 0x40, index, 0))
        bench.run(2 * MS)
    bench.controlword(0x06)
    assert bench.last(0x180 + NODE)[0] & 0x6F == 0x21  # immediately
    bench.run(200 * MS)
    replies = [data[1] | data[2] << 8 for _, can_id, data in bench.sent if can_id == 0x580 + NODE]
    assert replies == [0x1000, 0x1001, 0x1018, 0x6041, 0x6060]


def test_deaf_after_boot_up_ignores_sdos_for_its_time():
    bench = quirky(deaf_after_boot_up={"for_s": 0.5})
    bench.boot()
    request = struct.pack("<BHB4x", 0x40, 0x1000, 0)
    for _ in range(2):
        bench.send(0x600 + NODE, request)
        bench.run(250 * MS - 1)
    assert bench.times(0x580 + NODE) == []
    bench.run(2)
    bench.send(0x600 + NODE, request)
    bench.run(2 * MS)
    assert len(bench.times(0x580 + NODE)) == 1
    bench.nmt(0x81)
    bench.run(BOOT_UP + 10 * MS)
    bench.send(0x600 + NODE, request)
    bench.run(100 * MS)
    assert len(bench.times(0x580 + NODE)) == 1


def test_wire_quirks_follow_a_node_id_given_by_lss():
    """Check that node 9 has the quirks of node 5, the ID at construction."""
    bench = quirky("stray_emcy", deaf_after_boot_up={"for_s": 0.5}, lss=True)
    bench.run(BOOT_UP)
    for request in ("0401", "1109", "0400"):  # all to configuration; node-ID 9; to waiting
        bench.send(0x7E5, bytes.fromhex(request).ljust(8, b"\0"))
        bench.run(2 * MS)
    bench.run(BOOT_UP)
    assert len(bench.times(0x709)) == 1
    request = struct.pack("<BHB4x", 0x40, 0x1000, 0)
    bench.send(0x609, request)
    bench.run(500 * MS)
    assert bench.times(0x589) == []
    bench.send(0x609, request)
    bench.run(2 * MS)
    assert len(bench.times(0x589)) == 1
    bench.drive.stimulate("fault", 0x8611, bench.now)
    bench._drain()
    assert (len(bench.times(0x081)), bench.times(0x089)) == (1, [])


def test_late_boot_up_delays_the_boot_up_message():
    bench = quirky(late_boot_up={"by_s": 2.0})
    bench.run(3000 * MS)
    assert bench.times(0x700 + NODE) == [BOOT_UP + 2000 * MS]


def test_heartbeat_jitter_delays_within_its_maximum():
    bench = quirky(heartbeat_jitter={"max_s": 0.04})
    bench.boot()
    written = bench.now
    bench.set(0x1017, 0, 100, 2)
    bench.run(10_000 * MS)
    beats = bench.times(0x700 + NODE)[1:]
    late = [beat - written - number * 100 * MS for number, beat in enumerate(beats)]
    assert len(late) >= 99
    assert 0 <= min(late) < 5 * MS  # of 100 uniform values: 0.6 % of seeds have none below 5 ms
    assert 35 * MS < max(late) <= 40 * MS


def responses(bench: Bench, *requests: str) -> list[str]:
    """Return the SDO responses as hexadecimal bytes."""
    for request in requests:
        bench.send(0x600 + NODE, bytes.fromhex(request).ljust(8, b"\0"))
        bench.run(2 * MS)
    return [data.hex(" ") for _, can_id, data in bench.sent if can_id == 0x580 + NODE]


def test_size_not_indicated_sends_42h_with_four_bytes():
    """CiA 301, 7.2.4.3.6: e = 1, s = 0, so n is 0."""
    bench = quirky("size_not_indicated")
    bench.boot()
    assert responses(bench, "40 41 60 00", "40 00 10 00", "2F 60 60 00 03") == [
        "42 41 60 00 50 02 00 00",
        "42 00 10 00 92 01 02 00",
        "60 60 60 00 00 00 00 00",
    ]


def test_stale_sdo_bytes_are_those_of_the_response_before():
    """CANopenNode issue 345: 4F 0C 50 00 00 2E 30 2E after a string."""
    bench = quirky("stale_sdo_bytes")
    bench.boot()
    assert responses(bench, "40 00 10 00", "40 61 60 00", "2F 60 60 00 03", "40 41 60 00") == [
        "43 00 10 00 92 01 02 00",
        "4f 61 60 00 01 01 02 00",
        "60 60 60 00 01 01 02 00",
        "4b 41 60 00 50 02 02 00",
    ]


def test_statusword_bits_are_set_outside_the_mode():
    bench = quirky("statusword_bits")  # Schunk: 9250h, 9231h, 9233h; 8237h with bit 12 of pp
    bench.operational()
    words = [bench.statusword()]
    for controlword in (0x06, 0x07, 0x0F):
        bench.controlword(controlword)
        bench.run(30 * MS)
        words.append(bench.statusword() & ~REACHED)
    assert [f"{one:04X}" for one in words] == ["9250", "9231", "9233", "8237"]


def test_target_reached_in_fault_shows_bit_10():
    """As recorded, 0638h, but for bit 5, which CiA 402 leaves open."""
    bench = quirky("target_reached_in_fault")
    bench.enable(mode=1)
    bench.drive.stimulate("fault", 0x5201, bench.now)
    bench.run(100 * MS)
    assert bench.statusword() & ~0x20 == 0x0618
    bench.controlword(0x80)
    bench.run(10 * MS)
    assert bench.statusword() & 0x40F == 0


def test_emcy_has_the_vendor_bytes_until_its_reset():
    """Frames as recorded: ros2_canopen issue 298; 1001h is ours."""
    bench = quirky("emcy_vendor_bytes")
    bench.operational()
    bench.drive.stimulate("fault", 0x5201, bench.now)
    bench._drain()
    bench.controlword(0x80)
    emcys = [data for _, can_id, data in bench.sent if can_id == 0x080 + NODE]
    assert [emcy[:2].hex() + emcy[3:].hex() for emcy in emcys] == [
        "01520000007008",
        "00000000000000",
    ]


def test_emcy_after_boot_up_follows_each_boot_up():
    bench = quirky("emcy_after_boot_up")
    bench.boot()
    bench.nmt(0x82)
    bench.run(BOOT_UP)
    frames = [row for row in bench.hex_since(0) if row[:3] in ("705", "085")]
    assert frames == ["705#00", "085#0000000000000000"] * 2


def test_emcy_on_overrun_loses_frames_and_tells_once():
    bench = quirky(emcy_on_overrun={"frames": 2, "within_s": 0.001})
    bench.operational()
    bench.run(2 * MS)
    for word_ in (0x06, 0x07, 0x0F, 0x0F):
        bench.controlword(word_)
    bench.run(50 * MS)
    assert bench.statusword() & 0x6F == 0x23  # the third and the fourth one are lost
    emcys = [data.hex(" ") for _, can_id, data in bench.sent if can_id == 0x080 + NODE]
    assert emcys == ["10 81 11 14 00 00 00 00"]
