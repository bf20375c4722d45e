"""A conveyor and a gate, two parties: never both in motion, and the gate opens behind a piece."""

from contextlib import contextmanager, suppress

from motorhil.harness.swarm.properties import always, sometimes
from motorhil.motorapi import ControlMode, MotorError
from tests.system.swarm.defects import correct, defect
from tests.system.swarm.defects.truth import Truth

RIG = "carriage.toml"
PIECES = 3
STEP_RAD = 0.6
PAUSE_S = 0.4
LEASE_S = 1.0
PATIENCE_S = 12.0


class Lock:
    """A lock with a lease: it comes free by itself if its holder no longer renews it."""

    def __init__(self, runtime):
        self.runtime = runtime
        self.holder = None
        self.until_ns = 0

    def is_free(self):
        """Return True if nobody holds it now."""
        return self.holder is None or self.runtime.now_ns() >= self.until_ns

    def take(self, who, timeout_s):
        """Wait until it is free, and take it; return False if it never is."""
        if not self.runtime.wait_until(self.is_free, timeout_s):
            return False
        self.holder = who
        self.renew(who)
        return True

    def renew(self, who):
        """Keep it for another lease."""
        if self.holder == who:
            self.until_ns = self.runtime.now_ns() + round(LEASE_S * 1e9)

    def release(self, who):
        """Give it back."""
        if self.holder == who:
            self.holder = None


class Gate:
    """Each party locks the passage, moves, and gives it back when its motor surely stands."""

    def __init__(self, rig):
        self.rig, self.runtime = rig, rig.runtime
        self.truth = Truth(rig)
        self.lock = Lock(rig.runtime)
        self.conveyor, self.gate = rig.motors["left"], rig.motors["right"]
        self.pieces = 0  # that arrived at the gate
        self.is_over = False  # the conveyor has ended

    def run(self):
        """Run both parties to their end."""
        for motor in (self.conveyor, self.gate):
            try:
                motor.enable()
                motor.set_control_mode(ControlMode.SETPOINT)
            except MotorError:
                return
        parties = [
            self.runtime.spawn("conveyor", self.convey),
            self.runtime.spawn("gate", self.let_through),
        ]
        for party in parties:
            party.join()
        for party in parties:
            if party.error is not None:
                raise party.error
        always(self.truth.together_s < 0.05, "conveyor and gate never move together")

    # --- the parties -----------------------------------------------------------------------------

    def convey(self):
        """Bring pieces to the gate, one after another."""
        try:
            for number in range(1, PIECES + 1):
                with self.locked("conveyor", self.conveyor):
                    self.move(self.conveyor, number * STEP_RAD)
                self.pieces = number
                self.runtime.run_for(PAUSE_S)
        except MotorError:
            sometimes(True, "the conveyor gives up")
        finally:
            self.is_over = True

    def let_through(self):
        """Open and close the gate behind each piece."""
        try:
            for number in range(1, PIECES + 1):
                if not self.piece_comes(number):
                    return
                always(self.pieces >= number, "the gate opens behind a piece")
                with self.locked("gate", self.gate):
                    self.move(self.gate, 0.2)
                    self.move(self.gate, 0.0)
        except MotorError:
            sometimes(True, "the gate gives up")

    def piece_comes(self, number):
        """Wait for a piece; return False if none will come."""
        self.runtime.wait_until(lambda: self.pieces >= number or self.is_over)
        return self.pieces >= number

    # --- motions ---------------------------------------------------------------------------------

    @contextmanager
    def locked(self, who, motor):
        """Hold the lock while a motor moves; after a failure until it surely stands."""
        renewal = self.renewing(who)
        try:
            self.enter(who, motor)
            yield
        except MotorError:
            with suppress(MotorError):
                motor.stop()
                motor.wait_until_done(timeout_s=1.0)
            self.runtime.run_for(1.0)  # a lost drive stops by itself
            raise
        finally:
            renewal.cancel()
            self.lock.release(who)

    def enter(self, who, motor):
        """Lock the passage, and make the motor ready."""
        always(self.lock.take(who, PATIENCE_S), "the passage comes free")
        self.ready(motor)

    def renewing(self, who):
        """Renew the lock until this is cancelled."""
        return self.runtime.every(0.1, lambda: self.lock.renew(who))

    def ready(self, motor):
        """Make the motor ready, also after a fault."""
        if motor.fault() is not None:
            sometimes(True, "a fault is reset")
            motor.reset_fault()
            self.runtime.run_for(0.4)  # the contactor
        motor.enable()

    def move(self, motor, target):
        """Move to a place."""
        motor.set_setpoint(target)
        motor.start()
        motor.wait_until_done(timeout_s=2.0)


gate = correct(RIG)(Gate)


# --- defects -------------------------------------------------------------------------------------


@defect(RIG, "always | conveyor and gate never move together")
class ChecksThenActs(Gate):
    """A party looks whether the passage is free, prepares its motor, and only then locks it."""

    def enter(self, who, motor):
        always(self.runtime.wait_until(self.lock.is_free, PATIENCE_S), "the passage comes free")
        self.ready(motor)
        self.lock.holder = who
        self.lock.renew(who)


@defect(RIG, "always | the gate opens behind a piece")
class OpensByTheClock(Gate):
    """The gate opens a time after the start, in which a piece arrives."""

    def piece_comes(self, number):
        due_ns = round((0.4 + number * 1.1) * 1e9)
        self.runtime.wait_until(
            lambda: self.runtime.now_ns() >= due_ns, max(0.0, due_ns - self.runtime.now_ns()) / 1e9
        )
        return not self.is_over or self.pieces >= number


@defect(RIG, "always | conveyor and gate never move together")
class LeaseNotRenewed(Gate):
    """The lock is taken for one lease, in which a motion usually ends."""

    def renewing(self, who):
        return self.runtime.every(10.0, lambda: None)


@defect(RIG, "always | the passage comes free")
class KeepsTheLock(Gate):
    """After an error the lock is not given back; its renewal continues."""

    @contextmanager
    def locked(self, who, motor):
        renewal = self.renewing(who)
        self.enter(who, motor)
        yield
        renewal.cancel()
        self.lock.release(who)


@defect(RIG, "end | still runs")
class WaitsForADeadParty(Gate):
    """The gate waits for pieces, although the conveyor has ended."""

    def piece_comes(self, number):
        return self.runtime.wait_until(lambda: self.pieces >= number)
