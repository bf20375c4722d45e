"""Wireshark's dissector as a check of every frame of emulated CANopen nodes.

The session's tap (conftest) collects the results of `CanopenNode.take_output`, each frame once. All
frames of CANopen controllers, on a bus or on a bench, pass through it. At the end one capture goes
through one run of `tshark -d can.subdissector,canopen`. Other processes (wall-time tests) run the
same cores; their frames are not collected, and neither are those of compiled cores.

No frame is excluded. An identifier outside the predefined connection set (CiA 301, 7.3.3) is judged
by the service that normally has it. A third party's analyser would do the same.
"""

import shutil
import struct
import subprocess
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final

from motorhil.emulators.canopen.node import CanopenNode

LINKTYPE_CAN_SOCKETCAN: Final = 227  # identifier in network byte order, see pcap-linktype
COLUMNS: Final = ("canopen.function_code", "_ws.malformed", "_ws.expert.message")
# Wireshark's function codes, the upper four bits of an identifier.
_ERROR_CONTROL: Final = 14
_NO_SERVICE: Final = 15  # except LSS
_LSS: Final = (0x7E4, 0x7E5)


def tshark() -> str | None:
    """Return the path of tshark, or None if it is missing (apt-get install tshark)."""
    return shutil.which("tshark")


def collect_sent(into: set[bytes]) -> Callable[[], None]:
    """Collect all nodes' frames from now on; return a function that ends it.

    Compiled cores are not collected, because a native class cannot be patched.
    """
    original = CanopenNode.take_output
    collect = into.update

    def take_output(node: CanopenNode) -> Sequence[bytes]:
        frames = original(node)
        if frames:
            collect(frames)
        return frames

    def tap(method: Callable[[CanopenNode], Sequence[bytes]]) -> None:
        CanopenNode.take_output = method  # type: ignore[method-assign]  # that is what a tap is

    try:
        tap(take_output)
    except TypeError:
        return lambda: None
    return lambda: tap(original)


def capture(frames: Iterable[bytes]) -> bytes:
    """Return a classic pcap of can_frames."""
    rows = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN)]
    for frame in frames:
        can_id, length = struct.unpack_from("<IB", frame)
        packet = struct.pack(">IB3x", can_id, length) + frame[8 : 8 + length]
        rows.append(struct.pack("<IIII", 0, 0, len(packet), len(packet)) + packet)
    return b"".join(rows)


def dissected(program: str, path: Path, columns: Sequence[str] = COLUMNS) -> list[dict[str, str]]:
    """Return each frame of a capture as Wireshark reads it, by column."""
    command = [program, "-n", "-r", str(path), "-d", "can.subdissector,canopen", "-T", "fields"]
    for column in columns:
        command += ["-e", column]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return [dict(zip(columns, row.split("\t"), strict=True)) for row in done.stdout.splitlines()]


def complaints(program: str, frames: Iterable[bytes], folder: Path) -> list[str]:
    """Return the dissector's complaints, one line per frame, such as "581#4300: malformed"."""
    each = sorted(frames)
    path = folder / "sent.pcap"
    path.write_bytes(capture(each))
    found: list[str] = []
    for frame, row in zip(each, dissected(program, path), strict=True):
        can_id, length = struct.unpack_from("<IB", frame)
        service = int(row["canopen.function_code"] or "-1", 16)
        wrong = row["_ws.malformed"] or row["_ws.expert.message"]
        if not wrong and (service < 0 or (service == _NO_SERVICE and can_id not in _LSS)):
            wrong = "not CANopen"
        if not wrong and service == _ERROR_CONTROL and length != 1:
            wrong = f"error control of {length} bytes"
        if wrong:
            found.append(f"{can_id:03X}#{frame[8 : 8 + length].hex().upper()}: {wrong}")
    return found
