"""The server of Foxglove's protocol, read by a browser's WebSocket and judged by mcap's reader."""

from contextlib import contextmanager
from itertools import groupby

import pytest
from mcap.reader import make_reader

from motorhil.harness.cli.main import main
from motorhil.harness.view.foxglove import FoxgloveServer
from motorhil.harness.view.page import live_page
from motorhil.harness.view.server import ViewServer
from motorhil.harness.view.source import Source
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from tests.support.view.growing import TOKEN, session

pytestmark = pytest.mark.wall
TOPICS = ("/motor/drive_fl/state", "/motor/drive_fl/lock")

# ws-protocol, "Message Data": opcode 1, subscription (u32), log time (u64), payload; little endian.
CLIENT = """
(address, topics) => {
  window.got = {}; window.schemas = {}; window.times = 0;
  const names = {}, socket = new WebSocket(address, ["foxglove.sdk.v1"]);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => {
    if (typeof event.data === "string") {
      const told = JSON.parse(event.data);
      for (const channel of told.op === "advertise" ? told.channels : []) {
        window.schemas[channel.topic] = [channel.encoding, channel.schemaName];
        if (!topics.includes(channel.topic)) continue;
        names[channel.id] = channel.topic;
        const wanted = [{id: channel.id, channelId: channel.id}];
        socket.send(JSON.stringify({op: "subscribe", subscriptions: wanted}));
      }
      return;
    }
    const view = new DataView(event.data);
    if (view.getUint8(0) === 2) { window.times += 1; return; }
    const hex = [...new Uint8Array(event.data, 13)].map(b => b.toString(16).padStart(2, "0"));
    const kept = window.got[names[view.getUint32(1, true)]] ??= [];
    kept.push([String(view.getBigUint64(5, true)), hex.join("")]);
  };
}
"""


@contextmanager
def streamed(growing):
    """Stream a growing file; the context is a local page, and the address for viewers."""
    with read_trace(growing.path) as trace, FoxgloveServer("demo", 0) as viewers:
        source = Source(trace, session, viewers)
        with ViewServer(source, live_page("live"), lambda: "a page", token=TOKEN) as server:
            yield server.address.replace("/?", "/report?"), viewers.address


def recorded(path, topic):
    """Return (log time, payload) of the complete chunks, as mcap's reader tells them."""
    with path.open("rb") as file:
        found = make_reader(file).iter_messages([topic], log_time_order=False)
        return [[str(message.log_time), message.data.hex()] for _, _, message in found]


def subscribe(browser, page, address, topics=TOPICS):
    browser.call("Page.navigate", url=page)  # browsers keep pages from elsewhere off this machine
    browser.wait("document.body.textContent === 'a page'")
    browser.run(f"({CLIENT})({address!r}, {list(topics)!r})")
    for topic in topics:
        browser.wait(f"(window.got[{topic!r}] || []).length > 0")


def test_viewer_gets_the_messages_of_the_record(growing, browser):
    with streamed(growing) as places:
        growing.grow()
        subscribe(browser, *places)
        first = {topic: browser.run(f"window.got[{topic!r}][0]") for topic in TOPICS}
        growing.complete()
        known = {topic: recorded(growing.path, topic) for topic in TOPICS}
        for topic in TOPICS:
            last = known[topic][-1]
            browser.wait(f"window.got[{topic!r}].at(-1)[0] === {last[0]!r}")
        got = browser.run("window.got")
        assert browser.run("window.schemas")["/motor/drive_fl/lock"][0] == "protobuf"
        assert browser.run("window.times") > 0
    for topic in TOPICS:
        begun = known[topic].index(first[topic])  # the latest one when it subscribed
        # One that comes while the viewer subscribes may come twice.
        assert [one for one, _ in groupby(got[topic])] == known[topic][begun:]


def test_new_viewer_gets_the_latest_message_of_its_topic(growing, browser):
    topic = TOPICS[0]
    with streamed(growing) as places:
        growing.complete()
        last = recorded(growing.path, topic)[-1]
        subscribe(browser, *places)
        browser.wait(f"window.got[{topic!r}].at(-1)[0] === {last[0]!r}")
        subscribe(browser, *places)
        assert browser.run(f"window.got[{topic!r}]") == [last]


def test_port_in_use_is_told(growing):
    with FoxgloveServer("one", 0) as one:
        port = int(one.address.rpartition(":")[2])
        with pytest.raises(TraceError, match=f"127.0.0.1:{port}: cannot be opened.*another port"):
            FoxgloveServer("two", port)


def test_complete_file_is_refused(demo, capsys):
    assert main(["view", str(demo), "--foxglove", "0"]) == 2
    assert "is complete: nothing comes to be served; open the file in" in capsys.readouterr().err
