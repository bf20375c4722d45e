"""A program that carries out the steps of a plan: in a process of its own, or as a party.

python program.py PLAN NAME

The plan is JSON: by name, a list of steps [KIND, FACTS ...]; see the methods of `Script`. Each line
of output begins with "@" and ends with the rig's time [ns].
"""

import asyncio
import json
import os
import queue
import signal
import sys
import threading
import time
from pathlib import Path

import can

from motorhil.emulators.can.frame import can_id_of
from motorhil.motorapi import ControlMode, ControlVariable, MotorBusyError

ECHOED = 0x400
"""Added to the identifier of a frame that a program answers."""
PIDS = "pid-"


class Script:
    """The steps of one program.

    Args:
        name: the program's.
        rig: its part of the rig: `runtime`, `motors`, `open_bus`.
        tell: called with each line of output.
        locks: returns the context manager of a lock between programs.
        die: called with the way in which the program ends at its step `die_at`.
        kill: called with the name of another program and a signal.
        plan: {"steps": [...], "die_at": number or None, "how": the way}.
    """

    def __init__(self, name, rig, tell, locks, die, kill, plan):
        self.name = name
        self.rig = rig
        self._tell = tell
        self._locks = locks
        self._die = die
        self._kill = kill
        self._plan = plan
        self._count = 0
        self._threads = []
        self._periods = []
        self._mutexes = [threading.Lock() for _ in range(2)]
        self._queues = [queue.Queue() for _ in range(2)]
        self._events = [threading.Event() for _ in range(2)]
        self._buses = []
        self.bus = None

    def run(self):
        """Carry out all steps."""
        self.bus = self.rig.open_bus()
        self._buses.append(self.bus)
        try:
            self._carry_out(self._plan["steps"])
        except Exception:  # never for a death
            self._finish()
            raise
        self._finish()
        self.say("end")

    def _finish(self):
        for thread in self._threads:
            thread.join()
        for period in self._periods:
            period.cancel()
        for bus in self._buses:
            bus.shutdown()

    def say(self, *words):
        self._tell(f"@ {' '.join(map(str, words))} {self.rig.runtime.now_ns()}")

    def _carry_out(self, steps):
        for kind, *facts in steps:
            if self._count == self._plan["die_at"]:
                self._count += 1
                self.say("dies")
                self._die(self._plan["how"])
            self._count += 1
            getattr(self, kind)(*facts)

    # ---- time ----------------------------------------------------------------------------------

    def sleep(self, duration_s):
        time.sleep(duration_s)
        self.say("slept")

    def run_for(self, duration_s):
        self.rig.runtime.run_for(duration_s)
        self.say("ran")

    def clock(self):
        self.say("clock", time.monotonic_ns(), time.time_ns())

    # ---- frames --------------------------------------------------------------------------------

    def send(self, can_id, count):
        for number in range(count):
            data = bytes([number, self._count & 0xFF])
            self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def receive(self, timeout_s):
        message = self.bus.recv(timeout_s)
        self.say("received", message if message is None else f"{message.arbitration_id:X}")

    def farewell(self, own_id, other_id):
        """Send the last frame, and wait without a timeout for that of the other program."""
        self.send(own_id, 1)
        while self.bus.recv().arbitration_id != other_id:
            pass
        self.say("farewell")

    def echo(self, can_id):
        """Answer frames of this identifier, in a callback, for the rest of the program."""

        def hear(frame, time_ns, transmitted):
            if can_id_of(frame) == can_id and not transmitted:
                answer = can.Message(arbitration_id=can_id + ECHOED, is_extended_id=False)
                bus.send(answer)

        bus = self.rig.open_bus()  # one with listeners keeps no frames for a receiver
        self._buses.append(bus)
        self.rig.runtime.listen(bus, hear)

    def every(self, period_s, count, can_id):
        left = [count]

        def act():
            left[0] -= 1
            data = bytes([left[0]])
            self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            if not left[0]:
                period.cancel()

        period = self.rig.runtime.every(period_s, act)
        self._periods.append(period)

    def periodic(self, period_s, duration_s, can_id):
        message = can.Message(arbitration_id=can_id, is_extended_id=False)
        self.bus.send_periodic(message, period_s, duration_s)

    # ---- threads -------------------------------------------------------------------------------

    def thread(self, steps):
        thread = threading.Thread(target=self._carry_out, args=(steps,))
        self._threads.append(thread)
        thread.start()

    def mutex(self, number, timeout_s, hold_s):
        lock = self._mutexes[number]
        has_it = lock.acquire(timeout=timeout_s)
        self.say("mutex", has_it)
        if has_it:
            time.sleep(hold_s)
            lock.release()

    def put(self, number, value):
        self._queues[number].put(value)

    def get(self, number, timeout_s):
        try:
            self.say("got", self._queues[number].get(timeout=timeout_s))
        except queue.Empty:
            self.say("got nothing")

    def signal(self, number):
        self._events[number].set()

    def wait(self, number, timeout_s):
        self.say("event", self._events[number].wait(timeout_s))

    def gather(self, durations_s):
        """Sleep in the tasks of an event loop."""

        async def sleep(duration_s):
            await asyncio.sleep(duration_s)
            self.say("task slept")

        async def main():
            await asyncio.gather(*map(sleep, durations_s))

        asyncio.run(main())

    # ---- what programs share -------------------------------------------------------------------

    def lock(self, name, timeout_s, hold_s, can_id):
        try:
            with self._locks(self, name, timeout_s):
                self.say("lock", name)
                self.send(can_id, 1)
                time.sleep(hold_s)
                self.say("unlock", name)
        except MotorBusyError:
            self.say("no lock", name)

    def move(self, motor, target):
        """Move the motor to this position, and wait for the end."""
        wheel = self.rig.motors[motor]
        wheel.set_control_mode(ControlMode.SETPOINT)
        wheel.set_setpoint(target)
        wheel.start()
        wheel.wait_until_done(timeout_s=10)
        self.say("moved", f"{wheel.position():.6f}")

    def turn(self, motor, velocity, duration_s):
        """Turn the motor at this velocity for this time, and stop it."""
        wheel = self.rig.motors[motor]
        wheel.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        wheel.set_setpoint(velocity)
        wheel.start()
        time.sleep(duration_s)
        wheel.stop()
        wheel.wait_until_done(timeout_s=10)
        self.say("turned", f"{wheel.position():.6f}")

    def reserve(self, motor, timeout_s, target):
        """Move a motor that both programs use."""
        try:
            with self.rig.motors[motor].reserve(timeout_s=timeout_s):
                self.move(motor, target)
        except MotorBusyError:
            self.say("busy")

    def kill(self, name, number):
        self.say("kills", name)
        self._kill(name, number)
        self.rig.runtime.run_for(1e-6)  # the rig notes it after this turn


def kill(name, number):
    """Kill another program by a signal, and wait on the wall clock for its end."""
    try:
        pid = int(Path(f"{PIDS}{name}").read_text())
        os.kill(pid, number)
    except (FileNotFoundError, ProcessLookupError):
        return
    while _runs(pid):
        pass


def _runs(pid):
    """Return whether any of its threads still has its files open."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state not in "ZX" or len(os.listdir(f"/proc/{pid}/task")) > 1
    except OSError:
        return False


def die(how):
    """End this process."""
    if how == "raise":
        raise RuntimeError("ends by an exception")
    if how == "exit":
        os._exit(7)
    os.kill(os.getpid(), getattr(signal, how))
    raise AssertionError(f"survived {how}")


def _main(path, name):
    import motorhil
    from motorhil.motorapi.locking.process_lock import ProcessLock

    rig = motorhil.join()
    rig.open_bus = lambda: can.Bus(interface="emulated", channel="can0")
    Path(f"{PIDS}{name}").write_text(str(os.getpid()))
    locks = {}

    def lock(script, key, timeout_s):
        if key not in locks:
            locks[key] = ProcessLock(key, key, runtime=rig.runtime)
        return locks[key].acquire(rig.runtime, "a step", timeout_s)

    plan = json.loads(Path(path).read_text())[name]
    Script(name, rig, print, lock, die, kill, plan).run()


if __name__ == "__main__":
    _main(*sys.argv[1:])
