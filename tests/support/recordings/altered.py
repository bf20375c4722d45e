"""Altered copies of recordings."""

from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter


def copied(source, target, change):
    """Copy a recording with the payloads of `change(number, topic, time, payload)`; None: omit."""
    with read_trace(source) as trace, TraceWriter(target, trace.metadata) as writer:
        for one in trace.attachments:
            writer.attach(one.name, one.data, one.media_type, one.log_time_ns)
        channels = {}
        for number, (channel, time_ns, payload) in enumerate(trace.messages()):
            if channel.number not in channels:
                channels[channel.number] = writer.channel(channel.topic, channel.schema)
            changed = change(number, channel.topic, time_ns, payload)
            if changed is not None:
                writer.write(channels[channel.number], time_ns, changed)
    return target


def traffic(path, topic=None):
    """Return (time, payload) of the messages on each bus and line, by topic, in order."""
    found = {}
    with read_trace(path) as trace:
        for channel, time_ns, payload in trace.messages():
            if channel.topic.startswith(("/can/", "/modbus/", "/serial/")):
                found.setdefault(channel.topic, []).append((time_ns, payload))
    return found if topic is None else found[topic]
