"""Settings of the host for an I/O node, and of a servo that runs on the host."""

from collections.abc import Mapping
from dataclasses import fields, replace
from math import isfinite
from typing import Any, ClassVar, Final, Self, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.settings import NodeOptions
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError
from motorhil.settings import REQUIRED, SettingError, TableOf, number, setting, text, whole

_SERVO_MS: Final = (0.1, 20.0)
_WINDOW: Final[dict[str, Any]] = {"plausible": (1e-7, 100.0), "plausible_m": (1e-9, 10.0)}


@final
@frozen(kw_only=True)
class PidGains:
    """Gains of one motor's servo, all >= 0.

    Attributes:
        kp: current per error [A/U].
        ki: growth of the current per error and time [A/(U s)].
        kd: current per rate of the error [A s/U].
        velocity_feedforward: current per demanded velocity [A s/U], against viscous friction.
        acceleration_feedforward: current per demanded acceleration [A s²/U], for the inertia.
        friction_feedforward: current against dry friction, in the direction of motion [A].
        derivative_filter_s: time constant of a low-pass for de/dt, against quantisation noise [s].

    Raises:
        UsageError: a gain is not a finite number >= 0, or kp is 0.
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    velocity_feedforward: float = 0.0
    acceleration_feedforward: float = 0.0
    friction_feedforward: float = 0.0
    derivative_filter_s: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            given = getattr(self, field.name)
            value = as_number(given)
            if not isfinite(value) or value < 0.0:
                raise UsageError(f"PidGains: {field.name} is {given!r}, not a number >= 0")
            object.__setattr__(self, field.name, value)
        if self.kp == 0.0:
            raise UsageError("PidGains: kp is 0: the servo could not hold the motor")

    @classmethod
    def tuned(
        cls,
        bandwidth_rad_s: float,
        current_per_acceleration: float,
        *,
        friction_a: float = 0.0,
        velocity_feedforward: float = 0.0,
    ) -> Self:
        """Return gains that place all three poles of an inertia under PID control at one point.

        Args:
            bandwidth_rad_s: the magnitude of the poles [rad/s]. At a servo rate f, about f / 16 is
                a good value. Above f / 8 the loop is not stable: sampling and holding cost two
                cycles.
            current_per_acceleration: the current per acceleration of the motor with its load [A
                s²/U].
            friction_a: the current that overcomes dry friction [A].
            velocity_feedforward: see above.

        Raises:
            UsageError: the bandwidth or the inertia is not a number > 0.
        """
        for name, given in (
            ("bandwidth_rad_s", bandwidth_rad_s),
            ("current_per_acceleration", current_per_acceleration),
        ):
            value = as_number(given)
            if not (isfinite(value) and value > 0.0):
                raise UsageError(f"PidGains.tuned: {name} is {given!r}, not a number > 0")
        bandwidth, inertia = float(bandwidth_rad_s), float(current_per_acceleration)
        return cls(
            kp=3.0 * inertia * bandwidth * bandwidth,
            ki=inertia * bandwidth * bandwidth * bandwidth,
            kd=3.0 * inertia * bandwidth,
            acceleration_feedforward=inertia,
            velocity_feedforward=velocity_feedforward,
            friction_feedforward=friction_a,
        )

    def per_increment(self, increments_per_unit: float) -> Self:
        """Return these gains for a servo that counts `increments_per_unit` increments per U."""
        size = abs(increments_per_unit)
        return replace(
            self,
            kp=self.kp / size,
            ki=self.ki / size,
            kd=self.kd / size,
            velocity_feedforward=self.velocity_feedforward / size,
            acceleration_feedforward=self.acceleration_feedforward / size,
        )


@frozen(kw_only=True)
class IoOptions(NodeOptions):
    """Settings of the host for an I/O node, shared by all motors on its channels.

    The host's heartbeat must differ from the one that drives watch: another process may send that
    heartbeat as well, and the death of a servo would not be detected.
    """

    host_node_id: int = whole(
        126, 1, 127, "", "Node-ID of the host's heartbeat; not the one that drives watch."
    )
    cycle_ms: float = number(
        1.0, 0.1, 1000.0, "ms", "Period of the servo, and of SYNC.", plausible=_SERVO_MS
    )
    misses_max: int = whole(
        10, 1, 1_000_000, "", "Number of consecutive missed cycles that stops a motor."
    )
    counter: int = whole(
        0x6820, 0x2000, 0x9FFF, "", "Index of the counters; 6820h: CiA 406 beside CiA 401."
    )
    amplifier_tick_ms: float | None = number(
        None,
        0,
        1000.0,
        "ms",
        "Sampling period of an amplifier, for predicting skew; absent: not known.",
        plausible=_SERVO_MS,
    )


def _gain(default: float | None, name: str, unit: str, doc: str, **own: Any) -> Any:
    return number(default, 0, unit=unit, doc=doc, name=name, **own)


@final
@frozen(kw_only=True, slots=False)
class GainsTable:
    """Gains of the servo: each by itself, or tuned for a bandwidth."""

    bandwidth_rad_s: float | None = number(
        None,
        0,
        unit="rad/s",
        plausible=(0.1, 1e4),
        doc="Gains that put all three poles here; needs the acceleration feed-forward. Other gains"
        " replace them.",
        above=True,
    )
    kp: float | None = _gain(None, "kp_a_{u}", "A/{u}", "Current per error.")
    ki: float | None = _gain(None, "ki_a_{u}_s", "A/({u}·s)", "Growth of that current.")
    kd: float | None = _gain(None, "kd_a_s_{u}", "A·s/{u}", "Current per rate of the error.")
    velocity_feedforward: float | None = _gain(
        None, "velocity_feedforward_a_s_{u}", "A·s/{u}", "Current per demanded velocity."
    )
    acceleration_feedforward: float | None = _gain(
        None,
        "acceleration_feedforward_a_s2_{u}",
        "A·s²/{u}",
        "Current per demanded acceleration: of the motor and its load.",
    )
    friction_feedforward: float | None = _gain(
        None,
        "friction_feedforward_a",
        "A",
        "Current against Coulomb friction.",
        plausible=(1e-5, 100.0),
    )
    derivative_filter_s: float | None = _gain(
        None,
        "",
        "s",
        "Time constant of a low-pass filter for the rate of the error.",
        plausible=(1e-5, 1.0),
    )

    SCHEMA: ClassVar[Mapping[str, object]] = {
        "anyOf": [{"required": [key]} for key in ("kp_a_rad", "kp_a_m", "bandwidth_rad_s")]
    }

    def gains(self, unit: str) -> PidGains:
        """Return the gains, for positions in this unit.

        Raises:
            UsageError: a gain is missing, or not valid.
        """
        names = [one.name for one in fields(PidGains)]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        inertia = f"acceleration_feedforward_a_s2_{unit}"
        if self.bandwidth_rad_s is None:
            if "kp" not in given:
                remedy = f"give it, or bandwidth_rad_s with {inertia}"
                raise _missing(f"kp_a_{unit}", "is missing", remedy)
            return PidGains(**given)
        if "acceleration_feedforward" not in given:
            message = "is missing: bandwidth_rad_s needs it"
            remedy = "write the current per acceleration of the motor"
            raise _missing(inertia, message, remedy)
        tuned = PidGains.tuned(self.bandwidth_rad_s, given.pop("acceleration_feedforward"))
        return PidGains(**{**{name: getattr(tuned, name) for name in names}, **given})


def _missing(key: str, message: str, remedy: str) -> UsageError:
    cause = SettingError(("gains", key), message, remedy)
    error = UsageError(str(cause))
    error.__cause__ = cause
    return error


def _positive(default: float | None, unit: str, doc: str, **own: Any) -> Any:
    return number(default, 0, unit=unit, doc=doc, above=True, **own)


@final
@frozen(kw_only=True)
class HostServoTable(IoOptions):
    """A motor whose servo runs on the host, with an amplifier and an encoder on an I/O node."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Node-ID of the I/O node.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    channel: int = whole(1, 1, 4, "", "Channel of the node.")
    current_per_volt_a_v: float = number(
        REQUIRED,
        unit="A/V",
        doc="Current of the amplifier per volt; below 0: positive current turns to lower counts.",
        example="0.8",
        not_zero=True,
        plausible=(1e-3, 1e3),
    )
    torque_constant: float | None = _positive(
        None,
        "",
        "Torque [N·m], or force [N], at the output per current [A].",
        name="torque_constant_n_m_a",
        of_linear="torque_constant_n_a",
    )
    gains: GainsTable = setting(REQUIRED, TableOf(GainsTable), "Gains of the servo.")
    position_window: float | None = _positive(
        None,
        "{u}",
        "Distance within which a target counts as reached; absent: ten increments.",
        name="position_window_{u}",
        **_WINDOW,
    )
    settle_s: float = _positive(
        0.02, "s", "Time for which it must be within that window.", plausible=(1e-4, 10.0)
    )
    following_error_window: float | None = _positive(
        None,
        "{u}",
        "Following error that stops a motion; inf: none; absent: ten times the start tolerance.",
        name="following_error_window_{u}",
        may_be_inf=True,
        **_WINDOW,
    )
    following_error_s: float = _positive(
        0.01, "s", "Time for which it must be exceeded.", plausible=(1e-4, 10.0)
    )
    quick_stop_deceleration: float | None = _positive(
        None,
        "{u}/s²",
        "Deceleration of a quick stop; absent: that of the model.",
        name="quick_stop_deceleration_{u}_s2",
        plausible=(1e-3, 1e6),
        plausible_m=(1e-4, 1e3),
    )
