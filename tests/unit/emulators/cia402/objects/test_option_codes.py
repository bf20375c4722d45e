"""Each option code has its own motion, measured at the shaft: 605Ah to 605Eh, 6007h (CiA 402-2).

Expected values follow from the plant's data by mechanics. Ramp: its slope. Current limit:
(k i + friction) / J. Short circuit: the current k w / R and no energy back into the supply.
Coasting: friction only.
"""

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import MS, Bench

PLANT = {"preset": "wheel_60w"}
V, SLOW, QUICK = 20_000, 100_000, 250_000
LIMIT = 400  # 6072h: well above the ramps' need, well below the power stage
RAMP, QUICK_RAMP, CURRENT, VOLTAGE, COAST = "ramp", "quick ramp", "current", "voltage", "coast"


def running() -> Bench:
    objects = {"6084h": SLOW, "6085h": QUICK, "6072h": LIMIT, "60FFh": V, "6083h": 1_000_000}
    bench = Bench(objects=objects, plant=PLANT)
    bench.enable(mode=3)
    bench.run(600 * MS)
    assert bench.read(0x606C) == pytest.approx(V, rel=0.02)
    return bench


class Stop:
    """Motion of the shaft from now on: speed at every ms, peak current, regenerated power."""

    def __init__(self, bench: Bench) -> None:
        plant = bench.drive.settings.plant
        self.inc_s: list[float] = []
        self.most_a = self.regained_w = 0.0
        per_rad = plant.gear_ratio * plant.encoder_increments_rev / 6.283185307179586
        bench.run(2 * MS)  # the command takes effect at the next tick
        while not self.inc_s or (self.inc_s[-1] > 0.2 * V and len(self.inc_s) < 400):
            bench.run(1 * MS)
            truth = bench.drive.snapshot(bench.now)
            self.inc_s.append(truth["velocity_rad_s"] * per_rad)
            current = truth["current_a"]
            shaft = truth["velocity_rad_s"] * plant.gear_ratio
            volts = plant.resistance_ohm * current + plant.torque_constant_n_m_a * shaft
            self.most_a = max(self.most_a, abs(current))
            self.regained_w = max(self.regained_w, -volts * current)
        self.ms_to_a_fifth = len(self.inc_s)
        self.supply_w = plant.supply_v * plant.current_max_a

    def kind(self, bench: Bench) -> str:
        plant = bench.drive.settings.plant
        a_per_inc_s2 = plant.inertia_kg_m2() / (
            plant.torque_constant_n_m_a * plant.increments_per_rad()
        )
        limit_a = LIMIT / 1000 * plant.current_max_a
        if self.most_a < 1e-6:
            return COAST
        way = self.inc_s[0] - self.inc_s[-1]
        mean = way / max(1e-3, (len(self.inc_s) - 1) * 1e-3)
        for name, ramp in ((RAMP, SLOW), (QUICK_RAMP, QUICK)):
            if mean == pytest.approx(ramp, rel=0.08):
                return name
        if self.most_a == pytest.approx(limit_a, rel=0.02):
            assert mean > 0.8 * limit_a / a_per_inc_s2
            return CURRENT
        shorted_a = plant.torque_constant_n_m_a * V / plant.increments_per_rad()
        assert self.most_a == pytest.approx(shorted_a / plant.resistance_ohm, rel=0.15)
        assert self.regained_w < 0.02 * self.supply_w
        return VOLTAGE


END = PdsState.SWITCH_ON_DISABLED
STAYS = PdsState.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(
    ("option", "kind", "end"),
    [
        (0, COAST, END),
        (1, RAMP, END),
        (2, QUICK_RAMP, END),
        (3, CURRENT, END),
        (4, VOLTAGE, END),
        (5, RAMP, STAYS),
        (6, QUICK_RAMP, STAYS),
        (7, CURRENT, STAYS),
        (8, VOLTAGE, STAYS),
    ],
)
def test_605ah_quick_stop_has_its_motion_and_end_state(option, kind, end):
    bench = running()
    bench.set(0x605A, 0, option, 2)
    bench.controlword(0x0B)
    assert Stop(bench).kind(bench) == kind
    bench.run(2000 * MS)
    assert bench.truth("state") == end
    if end is STAYS:
        assert bench.statusword() & 0x0400
        assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=0.01)
        at = bench.truth("position_inc")
        bench.drive.stimulate("load_torque_n_m", 1.0, bench.now)
        bench.run(1000 * MS)
        assert abs(bench.truth("position_inc") - at) <= 2  # the motor holds its position
        bench.drive.stimulate("load_torque_n_m", 0.0, bench.now)
        bench.controlword(0x0F)  # transition 16
        bench.run(300 * MS)
        assert bench.read(0x606C) == pytest.approx(V, rel=0.02)


@pytest.mark.parametrize(
    ("option", "kind"), [(1, RAMP), (2, QUICK_RAMP), (3, CURRENT), (4, VOLTAGE)]
)
@pytest.mark.parametrize("mode", [3, 9])
def test_605dh_halt_has_its_motion(option, kind, mode):
    bench = running()
    bench.set(0x6060, 0, mode, 1)
    bench.set(0x605D, 0, option, 2)
    bench.controlword(0x10F)
    assert Stop(bench).kind(bench) == kind
    bench.run(2000 * MS)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED
    assert bench.read(0x606C) == 0
    assert bench.statusword() & 0x0400 or mode == 9  # reserved in csv
    bench.controlword(0x0F)
    bench.set(0x60FF, 0, V, 4)
    bench.run(600 * MS)
    assert bench.read(0x606C) == pytest.approx(V, rel=0.02)


@pytest.mark.parametrize(
    ("option", "kind"), [(0, COAST), (1, RAMP), (2, QUICK_RAMP), (3, CURRENT), (4, VOLTAGE)]
)
def test_605eh_fault_reaction_has_its_motion(option, kind):
    bench = running()
    bench.set(0x605E, 0, option, 2)
    bench.drive.stimulate("fault", 0x2310, bench.now)
    stop = Stop(bench)
    assert stop.kind(bench) == kind
    bench.run(2000 * MS)
    assert bench.truth("state") == PdsState.FAULT
    assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("index", "word", "option", "kind", "end"),
    [
        (0x605B, 0x06, 0, COAST, PdsState.READY_TO_SWITCH_ON),
        (0x605B, 0x06, 1, RAMP, PdsState.READY_TO_SWITCH_ON),
        (0x605C, 0x07, 0, COAST, PdsState.SWITCHED_ON),
        (0x605C, 0x07, 1, RAMP, PdsState.SWITCHED_ON),
    ],
)
def test_605bh_and_605ch_have_their_motion_and_end_state(index, word, option, kind, end):
    bench = running()
    bench.set(index, 0, option, 2)
    bench.controlword(word)
    assert Stop(bench).kind(bench) == kind
    bench.run(2000 * MS)
    assert bench.truth("state") == end


@pytest.mark.parametrize(
    ("option", "kind", "end"),
    [
        (0, None, PdsState.OPERATION_ENABLED),
        (1, QUICK_RAMP, PdsState.FAULT),  # by 605Eh
        (2, COAST, PdsState.SWITCH_ON_DISABLED),
        (3, QUICK_RAMP, PdsState.SWITCH_ON_DISABLED),  # by 605Ah
    ],
)
def test_6007h_abort_connection_has_its_motion(option, kind, end):
    bench = running()
    bench.set(0x6007, 0, option, 2)
    bench.nmt(0x02)  # stop remote node: no host controls it any more
    stop = Stop(bench)
    if kind is not None:
        assert stop.kind(bench) == kind
    else:
        assert min(stop.inc_s) == pytest.approx(V, rel=0.02)
    bench.run(2000 * MS)
    assert bench.truth("state") == end


@pytest.mark.parametrize(
    ("index", "refused"),
    [
        (0x6007, (-1, 4)),
        (0x605A, (-1, 9)),
        (0x605B, (-1, 2)),
        (0x605C, (-1, 2)),
        (0x605D, (-1, 0, 5)),
        (0x605E, (-1, 5)),
    ],
)
def test_option_code_without_a_motion_is_rejected(index, refused):
    bench = Bench()
    bench.boot()
    before = bench.read(index)
    for code in refused:
        assert bench.write(index, 0, code, 2) == 0x0609_0030
    assert bench.read(index) == before
