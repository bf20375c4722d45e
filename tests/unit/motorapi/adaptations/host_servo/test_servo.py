"""The servo on a simulated motor: its law, saturation, anti-windup, wrapping."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.adaptations.host_servo.demand import (
    CURRENT,
    POSITION,
    VELOCITY,
    Braking,
    Course,
    Led,
    Rated,
    Scales,
    Tracked,
    course_of,
)
from motorhil.motorapi.adaptations.host_servo.servo import Servo, ServoLimits
from motorhil.motorapi.adaptations.host_servo.settings import PidGains
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import PluginError, UsageError
from motorhil.motorapi.motion import Motion

T = 0.001
GAINS = PidGains(kp=0.02, ki=0.4, kd=0.0004)
LIMITS = ServoLimits(
    current_max_a=8.0,
    velocity_max=60_000.0,
    following_error=inf,
    following_s=0.01,
    stall_s=0.1,
    short_s=0.3,
    window=10.0,
    velocity_window=500.0,
    settle_s=0.02,
    deceleration=200_000.0,
)


def limits(**changed: float) -> ServoLimits:
    return replace(LIMITS, **changed)


class Broken:
    """A demand, or a derivative of it, that is not a number from the second cycle on."""

    initial_argument = 0.0
    final_argument = 1.0

    def __init__(self, name: str, bad: float) -> None:
        self._name = name
        self._bad = bad

    def _told(self, name: str, argument: float) -> float:
        return self._bad if name == self._name and T < argument < 1.0 else 0.0

    def value(self, argument: float) -> float:
        return self._told("value", argument)

    def first(self, argument: float) -> float:
        return self._told("first", argument)

    def second(self, argument: float) -> float:
        return self._told("second", argument)


class Inertia:
    """x'' = current / m, rounded down to integer increments; the output acts one cycle later."""

    def __init__(self, servo: Servo, m: float = 1.8e-6) -> None:
        self.servo = servo
        self.m = m
        self.x = self.v = 0.0
        self.blocked = False
        self.pushed = 0.0  # external acceleration
        self.cycle = 0
        self._waiting = 0.0
        self.counts: list[int] = []

    def run(self, cycles: int, each: Callable[[], None] = lambda: None) -> None:
        for _ in range(cycles):
            self.cycle += 1
            count = int(self.x // 1.0)
            self.counts.append(count)
            acting, self._waiting = self._waiting, self.servo.step(count, self.cycle)
            if self.blocked:
                self.v = 0.0
            else:
                a = acting / self.m + self.pushed
                self.x += self.v * T + 0.5 * a * T * T
                self.v += a * T
            each()


def ready(gains: PidGains = GAINS, bounds: ServoLimits = LIMITS) -> Inertia:
    servo = Servo(T)
    motor = Inertia(servo)
    motor.run(2)
    servo.begin(Course(POSITION, 0.0), gains, bounds, motor.cycle)
    return motor


def test_servo_without_course_has_no_current():
    servo = Servo(T)
    assert [servo.step(count, cycle) for cycle, count in enumerate((5, 50, -400), 1)] == [0.0] * 3
    assert servo.position == -400.0
    assert servo.demand == servo.position


def test_law_is_pid_with_feedforward_term_by_term():
    gains = PidGains(
        kp=0.01,
        ki=3.0,
        kd=2e-5,
        velocity_feedforward=1e-5,
        acceleration_feedforward=2e-6,
        friction_feedforward=0.3,
    )
    servo = Servo(T)
    servo.step(100, 1)
    servo.begin(Braking(130.0, -1000.0, 5000.0), gains, LIMITS, 1)
    out = servo.step(103, 2)
    # by hand: the counter began at 100; demand 1 ms after the start, feed-forward at 2.5 ms
    demand = 130.0 - 1.0 + 0.5 * 5000.0 * 1e-6
    error = demand - 103.0
    before = 100.0  # the demand at the beginning: the present position
    rate = (demand - before) / T - 3.0 / T
    velocity = -1000.0 + 5000.0 * 0.0025
    wanted = 0.01 * error + 2e-5 * rate + 1e-5 * velocity + 2e-6 * 5000.0 - 0.3
    assert abs(wanted) < 8.0
    assert out == pytest.approx(wanted, rel=1e-12)
    assert servo._integral == pytest.approx(3.0 * error * T, rel=1e-12)
    servo.step(200, 3)
    again = PidGains(kp=1e-300, friction_feedforward=0.3, derivative_filter_s=3 * T)
    servo.begin(Braking(200.0, 1000.0, 5000.0), again, LIMITS, 3)
    servo._integral = 0.0
    assert servo.step(201, 4) == pytest.approx(0.3)


def test_error_rate_is_filtered_as_the_gains_define():
    """A first-order low-pass: of a step, T / (T + tau) in the first cycle."""
    gains = PidGains(kp=1e-300, kd=1.0, derivative_filter_s=3 * T)
    servo = Servo(T)
    servo.step(0, 1)
    servo.begin(Course(POSITION, 0.0), gains, limits(current_max_a=1e9), 1)
    outs = [servo.step(-k, 1 + k) for k in (1, 2, 3)]
    assert outs == pytest.approx([1000 * (1 - 0.75**k) for k in (1, 2, 3)])


def test_stop_in_a_step_brakes_from_the_motors_position():
    motor = ready()
    motor.servo.begin(Course(POSITION, 1e6, is_step=True), GAINS, LIMITS, motor.cycle)
    motor.run(200)
    assert motor.v > 0.9 * LIMITS.velocity_max
    motor.servo.brake(100_000.0)
    outs: list[float] = []
    motor.run(30, lambda: outs.append(motor.servo.current_a))
    assert min(outs) > -4.0  # -0.18 A would suffice; no kick from a step of the demand


def test_led_course_feeds_forward_its_arguments_rates():
    class Ramp:
        name = "ramp"
        rate_max = None
        now = 0.0

        def value(self) -> float:
            return self.now

    class Cubic:
        initial_argument, final_argument = 0.0, 10.0

        def value(self, x: float) -> float:
            return x**3

        def first(self, x: float) -> float:
            return 3 * x**2

        def second(self, x: float) -> float:
            return 6 * x

    ramp = Ramp()
    course = Led(POSITION, Cubic(), 2.0, ramp)
    course.sample(0.0, T)
    ramp.now = 3.0
    course.sample(0.5, T)
    # the argument grows by 6 a second: dx/dt = 27 * 6, d2x/dt2 = 18 * 36, both times 2
    assert (course.value, course.velocity, course.acceleration) == (54.0, 324.0, 1296.0)
    assert not course.is_over
    ramp.now = 10.0
    course.sample(1.0, T)
    assert course.is_over


def test_position_step_is_not_a_velocity():
    motor = ready(PidGains(kp=1e-5, kd=1.0))
    servo = motor.servo
    servo.begin(Course(POSITION, 10_000.0, is_step=True), PidGains(kp=1e-5, kd=1.0), LIMITS, 2)
    motor.run(1)
    assert servo.current_a == pytest.approx(0.1)  # kp times the error, no kd term


def test_step_response_is_limited_to_the_maximum_velocity():
    motor = ready()
    motor.servo.begin(Course(POSITION, 100_000.0, is_step=True), GAINS, LIMITS, motor.cycle)
    fastest: list[float] = []
    motor.run(3000, lambda: fastest.append(motor.v))
    assert max(fastest) < 1.15 * LIMITS.velocity_max
    assert max(fastest) > 0.9 * LIMITS.velocity_max
    assert abs(motor.x - 100_000.0) < 2.0


def test_saturated_output_does_not_wind_up():
    motor = ready()
    motor.servo.begin(Course(POSITION, 20_000.0, is_step=True), GAINS, LIMITS, motor.cycle)
    motor.blocked = True
    outs: list[float] = []
    motor.run(5000, lambda: outs.append(motor.servo.current_a))  # five seconds against a wall
    assert max(outs) == 8.0
    motor.blocked = False
    free = ready()
    free.servo.begin(Course(POSITION, 20_000.0, is_step=True), GAINS, LIMITS, free.cycle)
    for one in (motor, free):
        one.counts.clear()
        one.run(2000)
    assert max(motor.counts) <= max(free.counts) + 50  # no more overshoot than without the wall


def test_blocked_velocity_is_not_recovered_by_going_faster():
    motor = ready()
    motor.servo.begin(Rated(VELOCITY, 0.0, 20_000.0, inf, inf), GAINS, LIMITS, motor.cycle)
    motor.run(500)
    motor.blocked = True
    motor.run(3000)
    assert motor.servo.current_a == 8.0
    motor.blocked = False
    speeds: list[float] = []
    motor.run(1000, lambda: speeds.append(motor.v))
    assert max(speeds) < 20_000.0 * 1.6
    assert abs(speeds[-1] - 20_000.0) < 600.0


def test_constant_load_is_compensated_by_the_integral():
    motor = ready()
    motor.pushed = 1e6
    motor.run(4000)
    assert abs(motor.x) <= 2.0
    assert motor.servo.current_a == pytest.approx(-1e6 * motor.m, abs=0.2)


def test_counter_may_wrap_around():
    servo = Servo(T)
    servo.step(0x7FFF_FFF0, 1)
    start = servo.position
    servo.step(-0x8000_0000 + 0x10, 2)
    assert servo.position - start == 0x20
    servo.step(0x7FFF_FFF0, 3)
    assert servo.position == start


@given(st.lists(st.integers(-(2**30), 2**30), max_size=20), st.integers(-(2**31), 2**31 - 1))
def test_position_is_the_sum_of_counts_across_wraps(steps, first):
    servo = Servo(T)
    servo.restart(first)
    total = count = first
    for cycle, step in enumerate(steps, 1):
        total += step
        count = (count + step + 2**31) % 2**32 - 2**31
        servo.step(count, cycle)
        assert servo.position == total


def test_count_after_a_pause_is_the_first_one():
    servo = Servo(T)
    servo.step(0, 1)
    servo.forget()
    assert servo.measure(5000, 500) == 0
    assert (servo.position, servo.velocity) == (5000.0, 0.0)


def test_missed_cycles_cause_no_velocity():
    servo = Servo(T)
    servo.step(0, 1)
    for cycle in range(2, 200):
        servo.step(10 * (cycle - 1), cycle)
    before = servo.velocity
    servo.step(10 * 204, 205)  # five cycles were missed
    assert servo.velocity == pytest.approx(before, rel=1e-9)
    servo.look(10 * 204 + 3)  # a further count of that cycle
    assert servo.position == 10 * 204 + 3
    assert servo.velocity == pytest.approx(before, rel=1e-9)


def test_done_requires_the_settling_time_in_the_window():
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 100.0, is_step=True), GAINS, LIMITS, 0)
    for cycle in range(1, 20):
        servo.step(90, cycle)
        assert not servo.is_done
    servo.step(89, 20)  # one increment outside: it starts again
    for cycle in range(21, 40):
        servo.step(90, cycle)
        assert not servo.is_done
    servo.step(90, 40)
    assert servo.is_done


def test_stop_is_done_at_standstill():
    motor = ready()
    motor.servo.begin(Rated(VELOCITY, 0.0, 20_000.0, inf, inf), GAINS, LIMITS, motor.cycle)
    motor.run(500)
    motor.servo.brake(100_000.0)
    assert not motor.servo.is_done
    motor.run(200)
    assert not motor.servo.is_done
    motor.run(400)
    assert motor.servo.is_done
    assert abs(motor.v) < 500.0


def test_following_error_counts_if_it_lasts_but_not_in_a_step():
    bounds = limits(following_error=50.0)
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 0.0), GAINS, bounds, 0)
    for cycle in range(1, 10):
        servo.step(51, cycle)
        assert not servo.lags
    servo.step(50, 10)
    for cycle in range(11, 20):
        servo.step(51, cycle)
        assert not servo.lags
    servo.step(51, 20)
    assert servo.lags
    servo.begin(Course(POSITION, 9999.0, is_step=True), GAINS, bounds, 20)
    for cycle in range(21, 100):
        servo.step(51, cycle)
    assert not servo.lags


@pytest.mark.parametrize("approach", [10, 11])
def test_set_point_without_approach_fails_after_its_time(approach: int):
    """An approach by more than the window of 10 increments begins the time anew."""
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 9999.0, is_step=True), GAINS, limits(following_error=50.0), 0)
    lags = []
    for cycle in range(1, 201):
        servo.step(approach if cycle > 50 else 0, cycle)
        lags.append(servo.lags)
    assert lags.index(True) + 1 == (100 if approach == 10 else 151)


@pytest.mark.parametrize("stops_at", [19, 50, 300])
def test_standstill_beside_the_target_fails_after_its_time(stops_at: int):
    """300 cycles of standstill, which a movement by more than two increments begins anew."""
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 0.0), GAINS, LIMITS, 0)
    lags = []
    for cycle in range(1, 700):
        servo.step(20 + 3 * min(cycle, stops_at), cycle)  # the window has 10
        lags.append(servo.lags)
    assert lags.index(True) + 1 == stops_at + 20 + 300 - 1


def test_standstill_at_the_edge_of_the_window_fails_too():
    """Counts of 10 and 11 increments, one within the window and one beside it."""
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 0.0), GAINS, LIMITS, 0)
    lags = []
    for cycle in range(1, 700):
        servo.step(10 + cycle % 2, cycle)
        lags.append(servo.lags)
    assert not servo.is_done
    assert True in lags


def test_standstill_within_the_window_never_fails():
    servo = Servo(T)
    servo.step(0, 0)
    servo.begin(Course(POSITION, 0.0), GAINS, limits(settle_s=0.5), 0)  # longer than short_s
    for cycle in range(1, 700):
        servo.step(10, cycle)
        assert not servo.lags
    assert servo.is_done


def test_set_point_that_was_reached_does_not_fail_later():
    servo = Servo(T)
    servo.step(0, 0)
    bounds = limits(following_error=50.0)
    servo.begin(Course(POSITION, 0.0, is_step=True), GAINS, bounds, 0)
    for cycle in range(1, 30):
        servo.step(0, cycle)
    assert servo.is_done
    for cycle in range(30, 300):
        servo.step(1000, cycle)
    assert not servo.lags


def test_set_point_rates_are_kept_through_0():
    course = Rated(CURRENT, 2.0, -1.0, 4.0, 1.0)
    values = []
    for k in range(6):
        course.sample(0.5 * k, 0.0)
        values.append(course.value)
    # 2 A/s... shrinking at 1 A/s takes 2 s to 0, growing at 4 A/s a quarter of one to -1
    assert values == [2.0, 1.5, 1.0, 0.5, 0.0, -1.0]
    assert course.is_over


def test_torque_and_current_follow_the_counting_direction():
    motion = Motion(
        mode=ControlMode.SETPOINT,
        variable=ControlVariable.TORQUE,
        start=0.0,
        target=3.0,
        velocity=1.0,
        acceleration=1.0,
        deceleration=1.0,
    )
    course = course_of(motion, Scales(-1000.0, 1.5), 0.0, 0.0)
    course.sample(0.0, 0.0)
    assert (course.kind, course.value) == (CURRENT, -2.0)


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"kp": 0.0}, "kp is 0"),
        ({"kp": -1.0}, "kp is -1.0, not a number >= 0"),
        ({"kp": "1"}, "kp is '1', not a number"),
        ({"kp": 1.0, "ki": inf}, "ki is inf"),
        ({"kp": 1.0, "derivative_filter_s": float("nan")}, "derivative_filter_s is nan"),
    ],
)
def test_invalid_gains_are_refused(bad, told):
    with pytest.raises(UsageError, match=told):
        PidGains(**bad)


def test_tuned_gains_put_three_poles_at_the_bandwidth():
    """m s^3 + kd s^2 + kp s + ki = m (s + b)^3."""
    gains = PidGains.tuned(40.0, 0.05)
    assert (gains.kd / 0.05, gains.kp / 0.05, gains.ki / 0.05) == pytest.approx((120, 4800, 64000))
    for bad in ((0.0, 1.0), (1.0, 0.0), (inf, 1.0), ("x", 1.0)):
        with pytest.raises(UsageError, match=r"PidGains\.tuned"):
            PidGains.tuned(*bad)


@pytest.mark.parametrize("name", ["value", "first", "second"])
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_non_finite_demand_is_an_error_and_keeps_the_current(name: str, bad: float) -> None:
    motor = ready()
    motor.servo.begin(Tracked(POSITION, Broken(name, bad), 1.0), GAINS, LIMITS, motor.cycle + 1)
    motor.run(5)
    assert isinstance(motor.servo.error, PluginError)
    assert "not finite" in str(motor.servo.error)
    assert motor.servo.current_a == 0.0
    motor.servo.brake(LIMITS.deceleration)
    motor.run(50)
    assert motor.servo.is_done
