"""Published sets of messages for the tests of the analysis."""

from motorhil.motorapi.synchronization.can_response_time import BusLoad, Message

MS = 1_000_000
US = 1_000

# The SAE benchmark in the packing of Tindell & Burns, 17 messages, most urgent first: period [ms],
# data bytes, worst response to the end of EOF at 125, 250, 500 and 1000 kbit/s [us]. Source:
# can-physics, 6.5: the first column recalled from the papers, all recomputed by hand.
SAE_RATES = (125_000, 250_000, 500_000, 1_000_000)
SAE = (
    (1000, 1, 1416, 708, 354, 177),
    (5, 2, 2016, 1008, 504, 252),
    (5, 1, 2536, 1268, 634, 317),
    (5, 2, 3136, 1568, 784, 392),
    (5, 1, 3656, 1828, 914, 457),
    (5, 2, 4256, 2128, 1064, 532),
    (10, 6, 5016, 2508, 1254, 627),
    (10, 1, 8376, 2768, 1384, 692),
    (10, 2, 8976, 3068, 1534, 767),
    (10, 2, 9576, 3368, 1684, 842),
    (100, 1, 10096, 3628, 1814, 907),
    (100, 4, 19096, 3968, 1984, 992),
    (100, 1, 19616, 4228, 2114, 1057),
    (100, 1, 20136, 4488, 2244, 1122),
    (1000, 3, 28976, 4748, 2374, 1187),
    (1000, 1, 29496, 5008, 2504, 1252),
    (1000, 1, 29496, 5008, 2504, 1252),
)


def sae(rate: int) -> BusLoad:
    """Return the benchmark; each message has its own node, and its period as deadline."""
    messages = tuple(
        Message(0x78 + place, row[1], row[0] * MS, deadline_ns=(5 if place == 0 else row[0]) * MS)
        for place, row in enumerate(SAE)
    )
    return BusLoad("can0", rate, messages)


def davis() -> BusLoad:
    """Return the counter-example of Davis, Burns, Bril & Lukkien 2007: A, B and C of 1 ms each."""
    times = ((1, 2.5, 2.5), (2, 3.5, 3.25), (3, 3.5, 3.25))
    messages = tuple(
        Message(number, 7, int(period_ms * MS), deadline_ns=int(deadline_ms * MS))
        for number, period_ms, deadline_ms in times
    )
    return BusLoad("can0", 125_000, messages)
