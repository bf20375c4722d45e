"""Rigs with Modbus drives, and faults of their lines."""

from contextlib import contextmanager
from pathlib import Path

from hypothesis import strategies as st

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig

MS = 1_000_000
LINES = {
    "rtu": '[bus.line]\nkind = "modbus_rtu"\nbaud_bit_s = 115_200\nparity = "N"\n',
    "tcp": '[bus.line]\nkind = "modbus_tcp"\n',
}
DRIVE = """\
[controller.{name}]
kind = "{kind}"
bus = "line"
unit = {unit}
plant = {{ preset = "mast_20w" }}
switches = {{ home_rad = 0.3 }}
[motor.{name}]
adaptation = "{adaptation}"
controller = "{name}"
[motor.{name}.model]
gear_ratio = 100.0
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
position_min_rad = -6.0
position_max_rad = 6.0
"""
ADAPTATIONS = {"leadshine": "leadshine_pr", "oriental_az": "oriental_az"}


def text(adaptation="leadshine", line="rtu", names=("mast",)):
    """Return the rig text of drives of one kind on one line."""
    drives = [
        DRIVE.format(name=name, unit=unit, kind=ADAPTATIONS[adaptation], adaptation=adaptation)
        for unit, name in enumerate(names, 1)
    ]
    return "".join(('[rig]\nname = "line"\n', LINES[line], *drives))


@contextmanager
def opened(rig_text=None, seed=1):
    source = Source(Path("rig.toml"), text() if rig_text is None else rig_text)
    with Rig(parse_rig(source, installed_plugins()), seed=seed) as rig:
        yield rig


def truth(rig, name="mast"):
    return rig.controllers[name].snapshot()


def run_s(rig, time_s):
    rig.runtime.wait_until(lambda: False, time_s)


TIMED = (SerialFaultKind.DELAY, SerialFaultKind.PAUSE, SerialFaultKind.REPEAT)
PLACED = (SerialFaultKind.TRUNCATE, SerialFaultKind.PAUSE)


@st.composite
def rules(draw, name, kinds=tuple(SerialFaultKind)):
    """Inject a fault of the next requests or answers of a port."""
    kind = draw(st.sampled_from(kinds))
    return SerialFaultRule(
        name,
        kind,
        sender=draw(st.sampled_from(("host", "mast", None))),
        function=draw(st.sampled_from((None, 3, 6, 16))),
        skip=draw(st.integers(0, 12)),
        limit=draw(st.integers(1, 3)),
        delay_ns=draw(st.sampled_from((1, 3, 40, 150, 400))) * MS if kind in TIMED else 0,
        after=draw(st.integers(1, 12)) if kind in PLACED else 0,
        noise=b"\xff\x01\x03" if kind is SerialFaultKind.NOISE else b"",
    )
