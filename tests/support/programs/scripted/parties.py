"""Scripted programs as parties of one process: the model of programs in processes of their own.

Each has what a process has for itself: bus objects, hardware objects of its motors, the lead of its
clocks, and its death, after which nothing of it acts. A lock between programs is a queue.
"""

import threading
from contextlib import contextmanager
from functools import partial

import can

from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.rig.bus_load import traffic_of
from motorhil.harness.rig.names import Named
from motorhil.harness.rig.plugins import RigPlugins
from motorhil.harness.rig.reading import read_models
from motorhil.harness.virtual_time.stdlib import threads
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.motorapi.bus_context import BusContext
from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.synchronization.bus_load import declare_traffic
from tests.support.programs.scripted.program import Script


class Dead(BaseException):
    """Raised in the party of a program that has died."""


class PartyRuntime:
    """The runtime of the rig, whose periods belong to one program."""

    def __init__(self, runtime):
        self._runtime = runtime
        self.context = BusContext()
        self.periods = []

    def __getattr__(self, name):
        return getattr(self._runtime, name)

    def every(self, period_s, action):
        period = self._runtime.every(period_s, action)
        self.periods.append(period)
        return period


class PartyRig:
    """The part of the rig that one program has."""

    def __init__(self, rig):
        self.runtime = PartyRuntime(rig.runtime)
        self.lead = threads.Program(rig.runtime)
        self.threads = []
        self.buses = []
        self._rig = rig
        self._closers = []
        plugins, models = RigPlugins(rig.description), read_models(rig.description)
        self._of_motors = Named("bus", rig.description.buses, self._bus)

        def motor(name):
            built, close, _ = plugins.motor(
                name, models[name], self.runtime, self._of_motors.__getitem__
            )
            self._closers.append(close)
            return built

        self.motors = Named("motor", rig.description.motors, motor)

    def open_bus(self, name="can0"):
        bus = can.Bus(interface="emulated", channel=name)
        bus.runtime = self.runtime
        bus._motorhil_context = BusContext()
        self.buses.append(bus)
        return bus

    def _bus(self, name):
        bus = self.open_bus(name)
        self._closers.append(bus.shutdown)
        declare_traffic(bus, traffic_of(self._rig.description, name))
        return bus

    def close(self):
        while self._closers:
            self._closers.pop()()


class Leads:
    """The leads of the clocks of all programs, in the place of one for the process."""

    def __init__(self, runtime):
        self.runtime = runtime
        self.children = None
        self.parties = []
        self.rigs = {}

    def rig_here(self):
        return self.rigs.get(self.runtime.party_of_thread())

    def add(self, party):
        rig = self.rigs[party] = self.rig_here()
        rig.threads.append(party)
        self.parties.append(party)
        self.runtime.enrol(party)

    def look(self, party):
        rig = self.rigs.get(party)
        return self.runtime.now_ns() if rig is None else rig.lead.look(party)

    def from_now_s(self, party, duration_s):
        return threads.Program.from_now_s(self, party, duration_s)


class QueuedLock:
    """A lock whose waiters have it in the order of their requests."""

    def __init__(self):
        self._places = []  # the first one holds it

    @contextmanager
    def taken(self, script, timeout_s):
        place = script, object()
        self._places.append(place)
        try:
            is_first = self._places[0] is place
            if not is_first and timeout_s:
                runtime = script.rig.runtime
                is_first = runtime.wait_until(lambda: self._places[0] is place, timeout_s)
            if not is_first:
                raise MotorBusyError(motor="it", holder="another", since_ns=0)
            yield
        finally:
            if place in self._places:
                self._places.remove(place)

    def forget(self, script):
        self._places = [place for place in self._places if place[0] is not script]


class Parties:
    """All programs of a plan, as parties of an open rig.

    Attributes:
        lines: the output of all.
    """

    def __init__(self, rig, plans):
        self.lines = []
        self._rig = rig
        self._runtime = rig.runtime
        self._leads = Leads(rig.runtime)
        self._locks = {}
        self._scripts = {}
        self._dead = []
        self._abandoned = []
        self._mains = {
            name: rig.runtime.spawn(name, partial(self._run, name, plan))
            for name, plan in plans.items()
        }

    def wait(self):
        """Wait for the ends of all; the dead do not end by themselves."""

        def is_over():
            return all(one.finished or name in self._dead for name, one in self._mains.items())

        with self._in_virtual_time():
            try:
                self._runtime.wait_for_parties(is_over)
            except UsageError:  # all wait for one another
                self._runtime.wait_for_parties(is_over)
            self._rig.send_queued()
        self._runtime._waiters.extend(self._abandoned)  # ended when the rig is closed

    @contextmanager
    def _in_virtual_time(self):
        hook, threading.excepthook = threading.excepthook, lambda raised: None
        runtime, leads = self._runtime, self._leads
        try:
            with bus_settings(self._rig.description.buses), in_virtual_time(self._rig):
                threads._Stage.program = leads
                runtime.on_poll = lambda: leads.look(runtime.party_of_thread())
                yield
        finally:
            threading.excepthook = hook

    def _run(self, name, plan):
        rig = self._leads.rigs[self._mains[name]] = PartyRig(self._rig)
        rig.threads.append(self._mains[name])
        script = self._scripts[name] = Script(
            *(name, rig, lambda line: self.lines.append(f"{name}: {line}")),
            *(self._lock, partial(self._die, name), self._kill, plan),
        )
        try:
            script.run()
        except Dead:
            return
        except (RuntimeError, UsageError):
            pass
        rig.close()
        self._dead.append(name)

    def _lock(self, script, key, timeout_s):
        return self._locks.setdefault(key, QueuedLock()).taken(script, timeout_s)

    def _kill(self, name, number):
        if name in self._scripts and name not in self._dead:
            self._end(name)

    def _die(self, name, how):
        if how == "raise":
            raise RuntimeError
        self._end(name)
        raise Dead

    def _end(self, name):
        script, here = self._scripts[name], self._runtime.party_of_thread()
        self._dead.append(name)
        for period in script.rig.runtime.periods:
            period.cancel()
        for bus in script.rig.buses:
            bus.shutdown()
        for lock in self._locks.values():
            lock.forget(script)
        for party in script.rig.threads:
            party.is_ending = True
            if party is not here:
                self._abandoned += [one for one in self._runtime._waiters if one.party is party]
                self._runtime.abandon(party)
