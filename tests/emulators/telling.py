"""A medium that tells a node of an error, without one having happened."""


def tell(world, bus, name, message):
    """As the bus does with a delivery that is TOLD: the record has it, then the node named."""
    segment = world._segments[bus]
    (endpoint,) = (one for one in segment._by_port if one.name == name)
    now_ns = world.queue.now_ns
    for tap in segment.taps:
        tap(bus, now_ns, name, message)
    endpoint.told(message, now_ns)
