"""ADUs of a record, and as packets of a Wireshark capture, on port 502."""

import struct
from collections.abc import Iterable
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

SERVER_PORT = 502
_LINKTYPE_RAW = 101
_PSH_ACK = 0x18
_CLIENT, _SERVER = bytes((10, 0, 0, 1)), bytes((10, 0, 0, 2))


def to_pcap(adus: Iterable[tuple[int, str, bool, bytes]], target: Path) -> None:
    """Return the capture of (ns, sender, True if to the server, ADU)."""
    rows = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, _LINKTYPE_RAW)]
    sent = {True: 1, False: 1}
    for time_ns, _, to_server, adu in adus:
        source, to = (50_000, SERVER_PORT) if to_server else (SERVER_PORT, 50_000)
        head = struct.pack(
            *(">HHIIBBHHH", source, to, sent[to_server], sent[not to_server], 0x50, _PSH_ACK),
            *(0xFFFF, 0, 0),
        )
        sent[to_server] += len(adu)
        ends = (_CLIENT + _SERVER) if to_server else (_SERVER + _CLIENT)
        length = 20 + len(head) + len(adu)
        packet = struct.pack(">BBHHHBBH", 0x45, 0, length, 0, 0, 64, 6, 0) + ends + head + adu
        seconds, rest_ns = divmod(time_ns, 1_000_000_000)
        rows.append(struct.pack("<IIII", seconds, rest_ns, len(packet), len(packet)) + packet)
    target.write_bytes(b"".join(rows))


def exchanged(record: Path, topic: str) -> list[tuple[int, str, bool, bytes]]:
    """Return (ns, sender, True if to the server, ADU), read by mcap's own reader."""
    with record.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            (message.log_time, adu.sender, adu.direction == 2, adu.data)
            for _, _, message, adu in reader.iter_decoded_messages(topics=[topic])
        ]
