"""Server of Foxglove's WebSocket protocol: the messages of a recording while it is made.

Viewers subscribe to topics, which are the channels of the record with their schemas. A new
subscriber gets the latest message of its topic at once. A viewer that is too slow misses messages;
it cannot delay the rest.

Source: foxglove.dev, ws-protocol specification.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import TraceMessage

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client, ServerListener

HOST: Final = "127.0.0.1"
_BACKLOG: Final = 8_192  # messages for a viewer that does not read them
_TICK_NS: Final = 10_000_000  # between two announcements of the time


@final
class FoxgloveServer:
    """The server; a context manager that closes it. Pass it the messages in order.

    Attributes:
        address: its address.
    """

    def __init__(self, title: str, port: int) -> None:
        """Open the port on loopback; 0: any free one.

        Raises:
            TraceError: foxglove-sdk is not installed, or the port cannot be opened.
        """
        try:
            import foxglove
            from foxglove.websocket import Capability
        except ImportError:
            remedy = "pip install 'motorhil[foxglove]'"
            raise TraceError(
                f"foxglove:{port}", "cannot be served without foxglove-sdk", remedy=remedy
            ) from None
        self._context = foxglove.Context()
        self._channels: dict[str, Channel] = {}
        self._latest: dict[str, tuple[int, bytes]] = {}
        self._told_ns: int | None = None
        try:
            self._server = foxglove.start_server(
                name=title,
                host=HOST,
                port=port,
                capabilities=[Capability.Time],
                server_listener=_greeter(self._channels, self._latest),
                context=self._context,
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            raise TraceError(
                f"{HOST}:{port}", f"cannot be opened: {error}", remedy="choose another port"
            ) from None
        self.address: str = f"ws://{HOST}:{self._server.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    def __call__(self, message: TraceMessage) -> None:
        """Send a message to the viewers that have subscribed to its topic."""
        told, time_ns, data = message
        channel = self._channels.get(told.topic)
        if channel is None:
            import foxglove

            schema = told.schema and foxglove.Schema(
                name=told.schema.name, encoding=told.schema.encoding, data=told.schema.data
            )
            channel = foxglove.Channel(
                told.topic,
                schema=schema,
                message_encoding=told.encoding,
                context=self._context,
                metadata=told.metadata,
            )
            self._channels[told.topic] = channel
        self._latest[told.topic] = (time_ns, data)
        channel.log(data, log_time=time_ns)
        if self._told_ns is None or time_ns >= self._told_ns + _TICK_NS:
            self._told_ns = time_ns
            self._server.broadcast_time(time_ns)


def _greeter(
    channels: Mapping[str, "Channel"], latest: Mapping[str, tuple[int, bytes]]
) -> "ServerListener":
    """Return a listener that sends new subscribers the latest message of their topic."""
    from foxglove.websocket import ServerListener

    class Greeter(ServerListener):
        def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
            """Send the latest message; called in a thread of the server."""
            topic = channel.topic
            if topic in latest and topic in channels:
                time_ns, data = latest[topic]
                channels[topic].log(data, log_time=time_ns, sink_id=client.id)

    return Greeter()
