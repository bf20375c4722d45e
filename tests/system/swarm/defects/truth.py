"""The true state of a rig's controllers, which applications state their promises about."""

from motorhil.harness.swarm.properties import always

SAMPLE_S = 0.02
_AT_REST = 2.0  # increments in 20 ms


class Truth:
    """The true state of the motors, whatever they report."""

    def __init__(self, rig):
        self.rig = rig
        self.alone_s = 0.0  # the longest time that one motor was driven without the others
        self.together_s = 0.0  # the time in which all of several motors were driven
        self._alone_ns = None  # since when
        self._demands = {}
        self._resets = []
        rig.world.tap_events(self._heard)
        rig.runtime.every(SAMPLE_S, self._sample)

    def _heard(self, time_ns, level, name, text):
        if text in ("fault reset", "alarm reset"):
            self._resets.append(name)

    def _sample(self):
        before, now_ns = self._demands, self.rig.runtime.now_ns()
        self._demands = {name: self.demand(name) for name in self.rig.controllers}
        driven = [name for name in before if _differ(before[name], self._demands[name])]
        if len(driven) > 1:
            self.together_s += SAMPLE_S
        if 0 < len(driven) < len(before):
            if self._alone_ns is None:
                self._alone_ns = now_ns
            self.alone_s = max(self.alone_s, (now_ns - self._alone_ns) / 1e9)
        else:
            self._alone_ns = None

    def resets(self, name):
        """Return how many faults of a drive were reset."""
        return self._resets.count(name)

    def position(self, name):
        """Return the position of a motor [rad]."""
        return self.rig.controllers[name].snapshot()["position_rad"]

    def demand(self, name):
        """Return the position that the drive asks for now [increments], None without power."""
        truth = self.rig.controllers[name].snapshot()
        return truth["demand_inc"] if is_powered(truth) else None

    def driven(self, names):
        """Return the motors whose drives move them."""
        before = {name: self.demand(name) for name in names}
        self.rig.runtime.run_for(0.02)
        return [name for name in names if _differ(before[name], self.demand(name))]

    def require_rest(self, names, what):
        """Require that no drive asks for motion."""
        always(not self.driven(names), what)


def is_powered(truth):
    """Return True if a controller in this state drives its motor."""
    if "status" in truth:
        return bool(int(truth["status"]) & 2)  # a register drive of Leadshine's kind: enabled
    if "fault" in truth:
        return truth["mode"] >= 5.0  # moteus: any mode with a current
    return truth["state"] in (4.0, 5.0, 6.0)  # CiA 402: enabled, quick stop, fault reaction


def _differ(before, after):
    return before is not None and after is not None and abs(after - before) > _AT_REST
