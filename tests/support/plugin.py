"""A third-party plugin: an emulated controller and an adaptation, by entry point."""

import struct

from motorhil.emulators.controller import SettingError
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.state import Measurement, MotorState

MS = 1_000_000


def frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


class Echo:
    """A controller that boots with 700h, and answers 100h + node with 180h + node."""

    def __init__(self, settings, context):
        for key in settings:
            if key not in ("node_id", "delay_s", "plant", "eds"):
                raise SettingError((key,), "unknown key", "known: node_id, delay_s")
        plant = settings.get("plant", {})
        if plant.get("resistance_ohm", 1) <= 0:
            raise SettingError(("plant", "resistance_ohm"), "must be > 0 ohm", "write 1.0")
        self.node_id = settings["node_id"]
        if settings.get("delay_s", 0.0) < 0.0:
            raise ValueError("delay_s = -1.0: must be >= 0")
        self.delay_ns = round(settings.get("delay_s", 0.001) * 1e9)
        self.settings = settings
        self.context = context
        self.due = []
        self.out = []
        self.load = 0.0

    def start(self, now_ns):
        self.out.append(frame(0x700 + self.node_id, b"\0"))

    def receive(self, data, now_ns):
        self.due.append((now_ns + self.delay_ns, data[8:9]))

    def sent(self, data, now_ns):
        pass

    def wants_sent(self):
        return False

    def next_deadline_ns(self):
        return self.due[0][0] if self.due else None

    def expire(self, now_ns):
        while self.due and self.due[0][0] <= now_ns:
            self.out.append(frame(0x180 + self.node_id, self.due.pop(0)[1]))

    def take_output(self):
        out, self.out = self.out, []
        return out

    def take_events(self):
        return [("warning", f"{self.settings['eds']}:3: mended")] if "eds" in self.settings else []

    def stimulate(self, name, value, now_ns):
        if name != "load_torque_n_m":
            raise ValueError(f"no stimulus {name!r} (known: load_torque_n_m)")
        self.load = value

    def snapshot(self, now_ns):
        return {"load_torque_n_m": self.load}

    def identifiers(self):
        return [0x100 + self.node_id]

    def identifiers_revision(self):
        return 0


class BareMotor:
    def __init__(self, bus, settings, model, runtime):
        if "heartbeat" in settings:
            raise UsageError("heartbeat: unknown key; did you mean heartbeat_s?")
        self.ownership = Ownership(None)
        self.name = settings["name"]
        self.bus, self.settings, self.model, self.runtime = bus, settings, model, runtime
        self.closed = False

    def close(self):
        self.closed = True

    def latest(self):
        return Measurement(self.runtime.now_ns(), MotorState.DISABLED, position=0.5)


def controller(settings, context):
    return Echo(settings, context)


def adaptation(bus, settings, model, runtime):
    return BareMotor(bus, settings, model, runtime)
