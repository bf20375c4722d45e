"""Properties of a bus under random faults."""

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.port import DELIVERED, KIND_MASK, LOST
from motorhil.emulators.can.fault_rules import PARTING, FaultKind, FaultRule
from tests.support.can import frame_bits as wire
from tests.support.can.deliveries import BIT, Submission, confirmed, heard, run
from tests.support.can.faulty_bus import HOST, LEFT, NAMES, RIGHT, bus_with

# --- any faults


FOR_FRAMES = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE, FaultKind.CORRUPT)
KINDS = st.sampled_from((*FOR_FRAMES, *PARTING))  # the others are in test_can_bus_errors
SOME_PORTS = st.lists(st.sampled_from(NAMES), max_size=2, unique=True).map(tuple)


@st.composite
def rules(draw: st.DrawFn) -> tuple[FaultRule, ...]:
    made = []
    for number in range(draw(st.integers(0, 4))):
        kind = draw(KINDS)
        from_ns = draw(st.integers(0, 400)) * BIT // 2
        until_ns = from_ns + draw(st.integers(1, 400)) * BIT // 2
        if kind in PARTING:
            ports = draw(SOME_PORTS) or ("left",)
            rule = FaultRule(f"{number}", kind, ports=ports, from_ns=from_ns, until_ns=until_ns)
        else:
            rule = FaultRule(
                f"{number}",
                kind,
                ports=draw(SOME_PORTS),
                from_ns=from_ns,
                until_ns=draw(st.sampled_from([None, until_ns])),
                probability=draw(st.sampled_from([1.0, 0.5])),
                limit=draw(st.sampled_from([None, 2])),
                delay_ns=draw(st.integers(1, 300)) * BIT if kind is FaultKind.DELAY else 0,
            )
        made.append(rule)
    return tuple(made)


@st.composite
def traffic(draw: st.DrawFn) -> list[Submission]:
    submissions = []
    now_ns = 0
    for frame in draw(st.lists(wire.fields(), max_size=12)):
        now_ns += draw(st.sampled_from([0, 0, 500, 1000, 30_000, 60_000, 250_000]))
        submissions.append((now_ns, draw(st.integers(0, 2)), frame.can_frame()))
    return submissions


@given(rules(), traffic())
def test_faults_keep_confirmed_frames_complete_and_ordered(plan, submissions):
    bus = bus_with(*plan)
    deliveries = run(bus, submissions)
    aborted = 0
    for port in (LEFT, RIGHT, HOST):
        wanted = [frame for _, sender, frame in submissions if sender == port]
        known = [frame for _, frame in confirmed(deliveries, port)]
        remaining = iter(wanted)
        assert all(frame in remaining for frame in known)  # in their order
        assert len(known) + bus.node(port).aborted == len(wanted)
        assert bus.pending(port) == 0
        aborted += bus.node(port).aborted
    assert bus.next_deadline_ns() is None
    assert aborted == len([what for _, _, what, _ in bus.take_fault_events() if "not sent" in what])
    if not bus.statistics.collisions():
        assert bus.statistics.frames == len(submissions)
        assert not aborted
    event("faults fired" if sum(bus.faults_fired().values()) else "none fired")


@given(rules(), traffic(), st.integers(0, 3))
def test_same_seed_gives_same_faults(plan, submissions, seed):
    first, second = bus_with(*plan, seed=seed), bus_with(*plan, seed=seed)
    assert run(first, submissions) == run(second, submissions)
    assert first.take_fault_events() == second.take_fault_events()


@given(traffic())
def test_empty_plan_changes_nothing(submissions):
    plain = CanBus("can0")
    for name in NAMES:
        plain.attach(name)
    assert run(plain, submissions) == run(bus_with(), submissions)


@given(traffic())
def test_plan_without_hits_changes_nothing(submissions):
    other = FaultRule("elsewhere", FaultKind.DROP, sender="nobody")
    assert run(bus_with(), submissions) == run(bus_with(other), submissions)


@given(rules(), traffic())
def test_frame_is_heard_no_more_often_than_faults_explain(plan, submissions):
    bus = bus_with(*plan)
    deliveries = run(bus, submissions)
    twice = sum(bus.faults_fired()[rule.name] for rule in plan if rule.kind is FaultKind.DUPLICATE)
    sent = sum(1 for _, (_, _, kind) in deliveries if kind & KIND_MASK in (DELIVERED, LOST))
    for port in (LEFT, RIGHT, HOST):
        own = len(confirmed(deliveries, port))
        assert len(heard(deliveries, port)) <= sent - own + twice
