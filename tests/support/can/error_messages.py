"""A simulated error message of the medium to a node."""


def tell(world, bus, name, message):
    """Deliver an error message as the bus does with TOLD: first to the record, then to the node."""
    segment = world._segments[bus]
    (endpoint,) = (one for one in segment._by_port if one.name == name)
    now_ns = world.queue.now_ns
    for tap in segment.taps:
        tap(bus, now_ns, name, message)
    endpoint.told(message, now_ns)
