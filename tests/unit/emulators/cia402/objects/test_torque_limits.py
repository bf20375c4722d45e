"""Power-on limits of torque (6072h) and current (6073h)."""

from pathlib import Path

import pytest

from motorhil.emulators.cia402.settings import OWN_EDS
from tests.support.cia402.bench import Bench

LIMITS = {"6072h": 0x6072, "6073h": 0x6073}


def told(name: str) -> tuple[str, str]:
    return (
        "warning",
        f"{name} is 0 at power-on: no torque until a host writes it; set it in the rig (objects)",
    )


@pytest.mark.parametrize(("name", "index"), LIMITS.items())
def test_limit_of_0_in_the_file_is_served_and_told(tmp_path: Path, name: str, index: int):
    text = OWN_EDS.read_text("utf-8")
    head = f"[{index:X}]\n"
    (tmp_path / "zero.eds").write_text(text.replace(head, f"{head}DefaultValue=0\n"), "utf-8")
    bench = Bench(folder=tmp_path, eds="zero.eds")
    bench.boot()
    assert bench.read(index, signed=False) == 0
    assert told(name) in bench.events


@pytest.mark.parametrize(("name", "index"), LIMITS.items())
def test_limit_of_0_in_the_rig_is_served_and_told(name: str, index: int):
    bench = Bench(objects={name: 0})
    bench.enable(mode=4)
    assert bench.read(index, signed=False) == 0
    assert told(name) in bench.events
    bench.set(0x6071, 0, 500, 2)
    bench.run(50_000_000)
    assert bench.read(0x6077) == 0


def test_limit_without_a_value_is_that_of_the_motor():
    bench = Bench()
    bench.boot()
    assert bench.read(0x6072) == 1001  # 207.2 mN m of 6076h = 207
    assert bench.read(0x6073) == 1000
    assert not any("no torque" in text for _, text in bench.events)
