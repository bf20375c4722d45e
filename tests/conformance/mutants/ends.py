"""Mistakes in the end of motions, and in its notification."""

import re
from contextlib import suppress
from dataclasses import replace

from motorhil.motorapi import execution
from motorhil.motorapi import motor as motor_module
from motorhil.motorapi.adaptations.cia402.csp import StreamedMotion
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.adaptations.ideal.profiles import Led
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.errors import DeadlineExceeded, MotorError
from tests.conformance.mutants import mutant, replaced


@mutant("ideal", "DONE-01")
def late_from_above():
    """Arrival is checked with a one-sided window: backwards it takes longer."""

    def wrong(is_done):
        def done(self):
            run = self._physical.run
            motion = None if run is None else run.motion
            backwards = motion is not None and motion.distance < -0.5
            if not backwards or not is_done(self):
                return is_done(self)
            self.hardware._news.count += 1
            return self.hardware._course.over_ns + 500_000_000 <= self.runtime.now_ns()

        return done

    def again(look):
        def looked(self):
            return look(self) or 0.01

        return looked

    with (
        replaced(IdealMotor, "_is_done", wrong),
        replaced(IdealHwMotor, "look_again_s", again),
    ):
        yield


@mutant("cia402", "DONE-01", "SET-01")
def stale_done():
    """The bit "target reached" of the previous motion is taken for that of the new one."""
    ended = {}

    def wrong(is_done):
        def done(self):
            over = is_done(self) or ended.get(self, False)
            ended[self] = ended.get(self, False) or over
            return over

        return done

    with replaced(Cia402Motor, "_is_done", wrong):
        yield


def _in_milliseconds(seconds):
    return f"{1e3 * float(seconds[0]):.6f}"


@mutant("ideal", "DONE-02")
def last_heard_in_milliseconds():
    """The error of a wait that times out states the time of the last status in milliseconds."""

    def wrong(heard):
        return lambda motor: re.sub(r"[0-9.]+(?= s)", _in_milliseconds, heard(motor))

    with replaced(execution, "_last_heard", wrong):
        yield


@mutant("ideal", "DONE-02")
def a_wait_that_runs_out_stops_the_motor():
    """A wait that times out stops the motor."""

    def wrong(wait):
        def waited(motors, timeout_s, answer=None):
            try:
                wait(motors, timeout_s, answer)
            except DeadlineExceeded:
                for one in motors:
                    one.hooks.stop()
                raise

        return waited

    with replaced(motor_module, "wait_for_all", wrong):
        yield


@mutant("ideal", "DONE-03")
def nobody_is_told_of_the_end():
    """The end of a motion is known, but callbacks are not called."""

    def quiet(look):
        def looked(self, course):
            listeners, self._news.listeners = self._news.listeners, []
            look(self, course)
            self._news.listeners = listeners

        return looked

    with replaced(IdealHwMotor, "_look", quiet):
        yield


@mutant("ideal", "DONE-04")
def it_has_always_just_begun():
    """The hardware reports the present time as the start while the motor moves."""

    def wrong(times):
        def told(self):
            found = times(self)
            if found is None or self.hardware.is_over:
                return found
            return replace(found, started_ns=self.runtime.now_ns())

        return told

    with replaced(IdealMotor, "_motion_times", wrong):
        yield


@mutant("oriental_az", "DONE-02", "MEAS-01")
def it_moves_only_while_asked():
    """The drive stops if it was not polled for 0.2 s, and nothing else polls it."""

    def watched(fire):
        def fired(self):
            fire(self)
            heard = [self.runtime.now_ns()]
            self._heard = heard
            timer = self.runtime.every(0.05, lambda: look(timer))

            def look(timer):
                if self.runtime.now_ns() - heard[0] > 200_000_000:
                    timer.cancel()
                    self.hardware.post_stop(quick=False)

        return fired

    def asked(poll):
        def polled(self):
            if hasattr(self, "_heard"):
                self._heard[0] = self.runtime.now_ns()
            return poll(self)

        return polled

    with replaced(PolledMotor, "fire", watched), replaced(PolledMotor, "_poll", asked):
        yield


@mutant("cia402", "TRAJ-10")
def led_in_with_hesitation():
    """A motor beside the beginning of a stream is led there at a fifth of its acceleration."""

    def wrong(approach_of):
        def led(streamed, motion):
            return approach_of(streamed, replace(motion, acceleration=0.2 * motion.acceleration))

        return led

    with replaced(StreamedMotion, "_approach_of", wrong):
        yield


@mutant("ideal", "LEAD-02")
def an_argument_that_fails_stands_still():
    """A failing argument is as good as one that stands still."""

    def wrong(look):
        def looked(led, now_ns):
            with suppress(MotorError):
                look(led, now_ns)

        return looked

    with replaced(Led, "look", wrong):
        yield
