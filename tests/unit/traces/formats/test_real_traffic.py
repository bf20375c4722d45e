"""Users' files have the frames listed in ../shared/data/traffic/INDEX.md, or are refused."""

import re

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import open_source

pytestmark = pytest.mark.data

# name: (format, frames, unreadable lines, backward stamps)
FILES = {
    "roboteq_mbl1660_node12_candump.txt": ("candump", 596, 1, 0),  # the command line
    "ros2canopen_issue298_fault_recovery.candump.txt": ("candump", 64, 0, 0),
    "ros2canopen_issue356_nanotec_n5_boot.candump.txt": ("candump", 17, 0, 0),
    "ather_scooter_candump.txt": ("candump", 22379, 0, 0),
    "moteus_dynamometer_canfd_candump.txt": ("candump", 1251, 0, 0),
    "savvycan_example_candump.log": ("candump", 12974, 0, 0),
    "canopenlens_sample_amr_2wheel.log": ("candump", 14714, 0, 0),
    "canopen_machine_pcan1.trc": ("trc", 11283, 0, 0),
    "canopen_machine_pcanrouter_pcan3.trc": ("trc", 45422, 3, 0),  # DLC 10, 14 bytes
    "technosoft_ipos_segmented_sdo_and_pdo_mapping.pcan.txt": ("trc", 72, 0, 1),
    "rdm_inverter_bench_PV1.7.asc": ("asc", 20552, 0, 1788),
    "rdm_inverter_bench_PV1.4.asc": ("asc", 31625, 0, 3496),
    "uw_formula_cm_inverter_endurance_LOGS11.TXT": ("sd-rows", 56983, 0, 0),
    "uw_formula_cm_inverter_fault_on_stands_LOGS5.TXT": ("sd-rows", 63295, 0, 0),
}
REFUSED = (
    "tmotor_ak80_current_chirp.csv",
    "vfd_omron_cimr_v7az_modbus.ini",
    "canopen_machine_pcan1.trc.csv",  # another program's decoding, not a recording
)
ELSEWHERE = {
    "modbus_gateway_units1237_pipelined.pcap": "test_modbus_pcap",
    "modbus_plant1_tcp.pcap": "test_modbus_pcap",
    "modbus_quickdraw_part1.pcap": "test_modbus_pcap",
}


@pytest.mark.parametrize("name", FILES)
def test_real_file_matches_index(shared, tmp_path, name):
    path = shared / "data/traffic" / name
    form, frames, problems, backward = FILES[name]
    index = (shared / "data/traffic/INDEX.md").read_text()
    row = next(line for line in index.splitlines() if line.startswith(f"| {name} |"))
    assert int(row.split("|")[5]) == frames
    told = re.search(r"(\d+) backward", row)
    done = convert(path, tmp_path / "a.mcap", "mcap")
    found = done.findings
    assert (done.source.format, found.frames) == (form, frames)
    assert (len(found.problems), found.backward) == (problems, backward)
    assert told is None or int(told[1]) == backward
    if frames > 20_000:
        return
    convert(tmp_path / "a.mcap", tmp_path / "b.log", "candump-x")
    convert(tmp_path / "b.log", tmp_path / "c.mcap", "mcap")
    assert digest(tmp_path / "a.mcap") == digest(tmp_path / "c.mcap")


@pytest.mark.parametrize("name", REFUSED)
def test_real_file_without_frames_is_refused(shared, name):
    with pytest.raises(TraceError, match="holds no CAN traffic"):
        list(open_source(shared / "data/traffic" / name).frames(Findings()))


def test_every_file_of_index_is_tested(shared):
    index = (shared / "data/traffic/INDEX.md").read_text()
    named = set(re.findall(r"^\| (\S+\.\w+) \|", index, re.MULTILINE))
    assert named == {*FILES, *REFUSED, *ELSEWHERE}
    there = {path.name for path in (shared / "data/traffic").iterdir()} - {"INDEX.md"}
    assert there == named
