"""The channel: lines on two pipes; a server that does not read or has ended delays nothing."""

import json
import os
import threading

import pytest

from motorhil.harness.hands.channel import Channel


@pytest.fixture
def pipes():
    """Return the rig's channel, and the server's ends of its pipes."""
    requests, to_rig = os.pipe()
    from_rig, answers = os.pipe()
    ends = [requests, to_rig, from_rig, answers]
    yield Channel(requests, answers), to_rig, from_rig, ends
    for end in ends:
        os.close(end)


def lines(fd):
    os.set_blocking(fd, False)
    found = b""
    while True:
        try:
            more = os.read(fd, 1 << 20)
        except BlockingIOError:
            return [json.loads(line) for line in found.splitlines()]
        found += more


def test_requests_come_in_order_and_in_pieces(pipes):
    channel, to_rig, _, _ = pipes
    os.write(to_rig, b'{"id": 1}\n{"id"')
    channel.wait(0.0)
    assert list(channel.inbox) == [{"id": 1}]
    os.write(to_rig, b': 2}\nno json\n[1]\n{"id": 3}\n')
    channel.inbox.clear()
    channel.wait(0.0)
    assert list(channel.inbox) == [{"id": 2}, {"id": 3}]


def test_answers_and_states_are_lines(pipes):
    channel, _, from_rig, _ = pipes
    channel.tell_elements({"a": 1})
    channel.answer(4, "no")
    channel.tell_state({"b": 2})
    assert lines(from_rig) == [
        {"elements": {"a": 1}},
        {"id": 4, "problem": "no"},
        {"state": {"b": 2}},
    ]


def test_server_that_reads_late_gets_the_last_state_at_the_end(pipes):
    channel, _, from_rig, _ = pipes
    channel.tell_elements({"text": "x" * 200_000})  # more than a pipe holds
    channel.tell_state({"over": True})
    found = bytearray()

    def read():
        while found.count(b"\n") < 2:
            found.extend(os.read(from_rig, 1 << 16))

    reader = threading.Thread(target=read)
    reader.start()
    channel.finish()
    reader.join()
    assert json.loads(found.splitlines()[-1]) == {"state": {"over": True}}


def test_server_that_does_not_read_gets_the_latest_state(pipes):
    channel, _, from_rig, _ = pipes
    for number in range(2_000):
        channel.tell_state({"number": number, "text": "x" * 1000})
    told = lines(from_rig)
    assert len(told) < 100
    channel.wait(0.0)
    told += lines(from_rig)
    assert told[-1]["state"]["number"] == 1_999


def test_flood_of_requests_is_bounded(pipes):
    channel, to_rig, _, _ = pipes
    os.set_blocking(to_rig, False)
    for _ in range(10):
        os.write(to_rig, b'{"id": 1}\n' * 100)
        channel.wait(0.0)
    assert len(channel.inbox) == 100  # one reading beyond the limit of 64


def test_ended_server_leaves_the_rig_alone(pipes):
    channel, to_rig, _, ends = pipes
    os.close(to_rig)
    ends.remove(to_rig)
    channel.wait(0.0)
    assert not channel.is_open
    channel.tell_state({"a": 1})
    channel.wait(0.0)


def test_closed_answers_end_the_channel(pipes):
    channel, _, from_rig, ends = pipes
    os.close(from_rig)
    ends.remove(from_rig)
    channel.answer(1)
    assert not channel.is_open
