"""csv and cst: set-points at SYNC, linear in between, with their offsets. CiA 402-2."""

import struct

import pytest

from tests.support.cia402.bench import MS, NODE, Bench

CSP, CSV, CST = 8, 9, 10
FOLLOWS = 0x1000
LIMIT = 0x0800
PERIOD = 4
LIGHT = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}


def cyclic(mode: int, **objects: int) -> Bench:
    """Return an enabled bench in the mode: RPDO 4 (6040h, target) synchronous, 60C2h 4 ms."""
    values = {"1403h:2": 1, "60C2h:1": PERIOD, "6065h": 0xFFFF_FFFF, "1602h:2": 0x60B0_0020}
    values["1603h:2"] = {CSP: 0x607A_0020, CSV: 0x60FF_0020, CST: 0x6071_0010}[mode]
    bench = Bench(objects={**values, **objects}, plant=LIGHT)
    bench.enable(mode)
    return bench


def set_point(bench: Bench, value: int, word: int = 0x0F, code: str = "<Hi") -> None:
    bench.send(0x500 + NODE, struct.pack(code, word, value))
    bench.sync()


def after_each_tick(bench: Bench, key: str, ticks: int) -> list[float]:
    values = []
    for _ in range(ticks):
        bench.run(1 * MS)
        values.append(bench.truth(key))
    return values


def demands(bench: Bench, index: int, ticks: int) -> list[int]:
    """Return the object's value at each of the next ticks."""
    reader = bench.drive.od.get(index).reader
    values = []
    for _ in range(ticks):
        bench.run(1 * MS)
        bench.drive.axis.at(bench.now)
        values.append(reader())
    return values


def test_csv_velocity_is_linear_between_set_points():
    bench = cyclic(CSV)
    set_point(bench, 8_000)
    assert demands(bench, 0x606B, 6) == [0, 2_000, 4_000, 6_000, 8_000, 8_000]
    set_point(bench, -4_000)
    assert demands(bench, 0x606B, 6) == [8_000, 5_000, 2_000, -1_000, -4_000, -4_000]


@pytest.mark.parametrize(("mode", "index", "value"), [(CSV, 0x60FF, 10_000), (CST, 0x6071, 100)])
def test_motor_enabled_under_halt_waits_for_its_end(mode, index, value):
    bench = Bench(plant=LIGHT)
    bench.operational()
    bench.set(index, 0, value, 4 if mode == CSV else 2)
    bench.set(0x6060, 0, mode, 1)
    for word in (0x06, 0x07, 0x10F):
        bench.controlword(word)
        bench.run(30 * MS)
    assert not bench.statusword() & FOLLOWS
    assert bench.truth("velocity_rad_s") == 0.0
    bench.controlword(0x0F)
    bench.set(index, 0, value, 4 if mode == CSV else 2)
    bench.run(30 * MS)
    assert bench.truth("velocity_rad_s") > 0.0


def test_csv_uses_the_present_60ffh_when_it_starts():
    bench = Bench(plant=LIGHT)
    bench.operational()
    bench.set(0x60FF, 0, 10_000, 4)
    bench.enable(CSV)
    bench.run(200 * MS)
    assert bench.read(0x606C) == pytest.approx(10_000, abs=300)


def test_csv_adds_60b1h_and_reaches_the_velocity():
    bench = cyclic(CSV)
    bench.set(0x60B1, 0, 5_000, 4)
    set_point(bench, 20_000)
    for _ in range(100):
        bench.run(4 * MS)
        bench.sync()
    assert bench.read(0x606B) == 25_000
    plant = bench.drive.settings.plant
    turns_s = bench.truth("velocity_rad_s") * plant.gear_ratio / 6.283185307
    assert turns_s * plant.encoder_increments_rev == pytest.approx(25_000, rel=0.01)


def test_csv_above_6080h_is_limited_and_reported():
    bench = cyclic(CSV, **{"6080h": 300})  # rpm: 5 motor turns per second
    most = 5 * bench.drive.settings.plant.encoder_increments_rev
    set_point(bench, most + 1)
    bench.run(6 * MS)
    assert bench.read(0x606B) == most
    assert bench.statusword() & (LIMIT | FOLLOWS) == LIMIT
    set_point(bench, most)
    assert bench.statusword() & (LIMIT | FOLLOWS) == FOLLOWS


def test_cst_torque_is_linear_and_adds_60b2h():
    bench = cyclic(CST)
    bench.set(0x60B2, 0, 20, 2)
    bench.run(10 * MS)
    set_point(bench, 100, code="<Hh")
    assert demands(bench, 0x6074, 6) == [20, 45, 70, 95, 120, 120]
    assert bench.read(0x6077) == pytest.approx(120, abs=15)  # limited by the motor's back-EMF
    assert bench.statusword() & 0x3C00 == FOLLOWS


def test_cst_is_limited_by_6072h_and_6080h():
    bench = cyclic(CST, **{"6072h": 50, "6080h": 1200})
    set_point(bench, 100, code="<Hh")
    bench.run(10 * MS)
    assert bench.read(0x6074) == 50
    assert bench.statusword() & (LIMIT | FOLLOWS) == LIMIT
    for _ in range(500):
        bench.run(4 * MS)
        bench.sync()
    turns_s = bench.truth("velocity_rad_s") * bench.drive.settings.plant.gear_ratio / 6.283185307
    # within the resolution of the velocity: half an increment each millisecond
    assert turns_s == pytest.approx(1200 / 60, abs=0.25)  # the torque would reach 4000 rpm


def test_csp_60b0h_is_added_to_the_target():
    bench = cyclic(CSP)
    bench.set(0x60B0, 0, 30, 4)
    set_point(bench, 100)
    bench.run(10 * MS)
    assert bench.truth("demand_inc") == 130


def test_csp_60b0h_takes_effect_at_sync_with_its_target():
    bench = cyclic(CSP, **{"1402h:2": 1})
    bench.send(0x400 + NODE, struct.pack("<Hi", 0x0F, 30))  # RPDO 3: 6040h, 60B0h
    set_point(bench, 100)
    trace = after_each_tick(bench, "demand_inc", 6)
    assert trace == [0, 33, 65, 98, 130, 130]  # one line over one period, not two


def lag(bench: Bench, speed: int, fed: int) -> float:
    """Return the mean following error along a line at `speed`, after the start transient."""
    bench.set(0x60B1, 0, fed, 4)
    errors = []
    for cycle in range(150):
        set_point(bench, cycle * speed * PERIOD // 1000)
        bench.run(PERIOD * MS)
        if cycle >= 100:
            errors.append(bench.truth("following_error_inc"))
    return sum(errors) / len(errors)


def test_csp_60b1h_is_the_velocity_loop_feed_forward():
    """Check that a P loop lags by v / kp without feed-forward, and not with 60B1h = v."""
    speed = 20_000
    kp = Bench().drive.settings.gains.position_kp_1_s
    off = {"60FBh:2": 0}
    assert lag(cyclic(CSP, **off), speed, 0) == pytest.approx(speed / kp, rel=0.05)
    assert lag(cyclic(CSP, **off), speed, speed) == pytest.approx(0, abs=0.05 * speed / kp)
    assert lag(cyclic(CSP), speed, 0) == pytest.approx(0, abs=0.05 * speed / kp)


def test_csp_60b2h_is_a_current_that_applies_immediately():
    """Check against a load: fed forward, the integrator need not supply the torque."""
    dip = {}
    for fed in (0, 200):
        bench = cyclic(CSP)
        set_point(bench, 0)
        bench.run(100 * MS)
        bench.set(0x60B2, 0, fed, 2)
        unit = bench.drive.settings.plant.torque_constant_n_m_a
        rated = bench.drive.settings.plant.current_max_a * unit
        bench.drive.stimulate(
            "load_torque_n_m", 0.2 * rated * bench.drive.settings.plant.gear_ratio, bench.now
        )
        dip[fed] = max(abs(e) for e in after_each_tick(bench, "following_error_inc", 100))
        bench.set(0x60B2, 0, 0, 2)
    assert dip[200] < 0.4 * dip[0]


@pytest.mark.parametrize("mode", [CSP, CSV])
def test_offset_ends_with_its_mode(mode):
    """Check that removing an offset the loops compensated leaves the motor short of torque."""
    bench = cyclic(mode)
    bench.set(0x60B2, 0, 300, 2)
    bench.run(500 * MS)
    before = bench.truth("current_a")
    bench.set(0x6060, 0, 1, 1)
    bench.run(1 * MS)
    unit = bench.drive.settings.plant.current_max_a / 1000
    least = min(after_each_tick(bench, "current_a", 4))
    assert least < before - 100 * unit
    bench.run(500 * MS)
    assert bench.read(0x606C) == 0


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_halt_stops_and_reports_that_nothing_is_followed(mode):
    bench = cyclic(mode)
    code = "<Hh" if mode == CST else "<Hi"
    set_point(bench, 50, code=code)
    bench.run(10 * MS)
    set_point(bench, 50, word=0x10F, code=code)
    bench.run(400 * MS)
    assert bench.read(0x606C) == 0
    assert bench.statusword() & FOLLOWS == 0
    set_point(bench, 60, code=code)
    assert bench.statusword() & FOLLOWS
