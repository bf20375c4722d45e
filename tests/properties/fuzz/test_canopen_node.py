"""Random bus traffic: no exception, and the node still responds."""

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.canopen.nmt import NmtState
from tests.support.canopen.node_bench import MS, NODE_ID, Bench, Host, dictionary, put_pdo

INDICES = (0x1001, 0x1003, 0x1005, 0x1014, 0x1016, 0x1017, 0x1018, 0x1400, 0x1401, 0x1600, 0x1601,
           0x1800, 0x1801, 0x1A00, 0x1A01, 0x2000, 0x2001, 0x2003, 0x2004, 0x2006, 0x6040, 0x6060,
           0x607A, 0x1234)  # fmt: skip
VALUES = (0, 1, 2, 8, 9, 100, 255, 0x8000_0182, 0x182, 0x8000_0202, 0x202, 0x80, 0x6041_0010,
          0x2003_0001, 0x2004_0018, 0x2006_0040, 0x0005_0064, 0xFFFF_FFFF)  # fmt: skip


def mux(command: int, index: int, subindex: int, value: int) -> bytes:
    return bytes((command, index & 0xFF, index >> 8, subindex)) + value.to_bytes(4, "little")


REQUESTS = st.builds(
    mux,
    st.sampled_from([0x2F, 0x2B, 0x23, 0x22, 0x40, 0x21, 0x20, 0xC2, 0xA0]),
    st.sampled_from(INDICES),
    st.integers(0, 3),
    st.sampled_from(VALUES) | st.integers(0, 0xFFFF_FFFF),
)
ANY_DATA = st.binary(max_size=8)
IDENTIFIERS = st.sampled_from(
    [0x000, 0x080, 0x182, 0x202, 0x302, 0x602, 0x702, 0x705, 0x7E5, 0x4000_0602, 0x8000_0602]
)
COMMANDS = st.sampled_from([1, 1, 1, 2, 128, 129, 130]).map(lambda command: bytes((command, 0)))
FRAMES = st.one_of(
    st.tuples(st.just(0x602), REQUESTS | st.binary(min_size=8, max_size=8)),
    st.tuples(
        st.just(0x000),
        st.tuples(st.sampled_from([1, 1, 1, 2, 128, 129, 130]), st.just(0)).map(bytes),
    ),
    st.tuples(st.sampled_from([0x202, 0x302]), ANY_DATA),
    st.tuples(st.just(0x080), st.just(b"")),
    st.tuples(st.just(0x705), st.just(b"\x05")),
    st.tuples(IDENTIFIERS | st.integers(0, 0xFFFF_FFFF), ANY_DATA),
)
STEPS = st.lists(
    st.tuples(FRAMES, st.sampled_from([0, 0, 1, 1 * MS, 30 * MS, 400 * MS])), max_size=60
)


class Talkative(Host):
    """A device that reports an error and changes an object on every write."""

    bench: Bench | None = None

    def on_write(self, now_ns: int) -> None:
        assert self.bench is not None
        self.bench.node.emergency(0xFF00, 0x80, b"", now_ns)
        self.bench.node.object_changed(0x6041, 0, now_ns)


def fuzz_bench() -> Bench:
    od = dictionary()
    put_pdo(od, 0x1400, (0x6040_0010, 0x607A_0020), 1)
    put_pdo(od, 0x1401, (0x6060_0008,), 255)
    put_pdo(od, 0x1800, (0x6041_0010,), 255)
    put_pdo(od, 0x1801, (0x6041_0010, 0x6064_0020), 1)
    host = Talkative()
    bench = Bench(od, host=host)
    host.bench = bench
    return bench.boot()


@given(STEPS)
def test_random_frames_raise_nothing_and_node_responds(steps):
    bench = fuzz_bench()
    for (can_id, data), pause_ns in steps:
        bench.tell(can_id, data)
        bench.wait(pause_ns)
        deadline_ns = bench.node.next_deadline_ns()
        assert deadline_ns is None or deadline_ns >= bench.now_ns or pause_ns == 0
    event(f"ended in {NmtState(bench.node.state).name}")
    event(f"accepted a download: {any(text.startswith('582 60') for text in bench.frames())}")
    bench.wait(400 * MS)
    bench.tell(0x2000_0100, bytes(8))  # restarted, whatever error messages came before
    bench.tell(0x000, b"\x81\x00")
    bench.wait(300 * MS)
    assert "702 00" in bench.frames()
    assert bench.ask("40 18 10 01 00 00 00 00") == "43 18 10 01 04 00 00 00"
    bench.tell(0x000, b"\x01\x00")
    bench.frames()
    bench.tell(0x202, "0F 00 05 00 00 00")
    bench.tell(0x080)
    assert bench.od.integer(0x607A, 0, 0) == 5
    assert "282 40 02 00 00 00 00" in bench.frames()


@given(STEPS)
def test_same_frames_give_same_responses(steps):
    logs = []
    for _ in range(2):
        bench = fuzz_bench()
        for (can_id, data), pause_ns in steps:
            bench.tell(can_id, data)
            bench.wait(pause_ns)
        logs.append(bench.heard())
    assert logs[0] == logs[1]


def test_fuzz_reaches_remapping():  # otherwise the property above would prove little
    bench = fuzz_bench()
    for index, subindex, value, size in (
        (0x1800, 1, 0x8000_0182, 4),
        (0x1A00, 0, 0, 1),
        (0x1A00, 1, 0x2004_0018, 4),
        (0x1A00, 0, 1, 1),
        (0x1800, 1, 0x182, 4),
    ):
        assert index in INDICES
        assert value in VALUES
        assert bench.download(index, subindex, value, size) == ""
    assert bench.node.node_id == NODE_ID
