"""Settings of drives with MIT frames: models, their ranges, the table in a rig.

Five numbers in a frame are codes over ranges, which belong to a model's firmware edition. A drive
does not tell them (Damiao's does, in parameters).

Source: the parameter tables of mini-cheetah-motor-driver-socketcan 0.4.3, TMotorCANControl 1.2.6
and DM_Control_Python; bgkatz/motorcontrol, Core/Src/main.c.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, final

from motorhil.emulators.api import REQUIRED, MotorTable, amount, flags, positive, whole, word

NODE_ID_MAX: Final = 127


class Ranges(NamedTuple):
    """The largest position [rad], velocity [rad/s], torque [N m], stiffness and damping."""

    p: float
    v: float
    t: float
    kp: float = 500.0
    kd: float = 5.0


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """The behaviour of a family of drives.

    Attributes:
        answer_bytes: length of an answer.
        watchdog_s: longest time between commands [s]; 0: unlimited.
        zero_s: duration of setting the zero, in which nothing is answered [s].
        keeps_command: executes the last command when it is enabled again.
        keeps_zero: keeps the zero without power.
        faults: the code of each fault that the plant can cause, by flag of the axis.
        codes: all codes.
    """

    answer_bytes: int = 8
    watchdog_s: float = 0.0
    zero_s: float = 0.0
    keeps_command: bool = False
    keeps_zero: bool = True
    faults: Mapping[int, int]
    codes: range | tuple[int, ...]


MINI_CHEETAH: Final = Firmware(answer_bytes=7, watchdog_s=0.025, faults={}, codes=())
CUBEMARS: Final = Firmware(
    zero_s=1.2,
    keeps_command=True,
    keeps_zero=False,
    faults={flags.OVER_TEMPERATURE: 1, flags.OVER_VOLTAGE: 3, flags.UNDER_VOLTAGE: 4},
    codes=range(1, 7),
)
DAMIAO: Final = Firmware(
    faults={flags.OVER_TEMPERATURE: 0xC, flags.OVER_VOLTAGE: 8, flags.UNDER_VOLTAGE: 9},
    codes=range(8, 15),
)
ROBSTRIDE: Final = Firmware(
    faults={flags.OVER_TEMPERATURE: 4, flags.UNDER_VOLTAGE: 1}, codes=range(1, 64)
)

MODELS: Final[dict[str, tuple[Firmware, Ranges]]] = {
    "mini_cheetah": (MINI_CHEETAH, Ranges(12.5, 65.0, 40.0)),
    "ak80_6_v1": (CUBEMARS, Ranges(95.5, 45.0, 18.0)),
    "ak80_6_v1_1": (CUBEMARS, Ranges(12.5, 22.5, 12.0)),
    "ak80_6_v2": (CUBEMARS, Ranges(12.5, 76.0, 12.0)),
    "ak80_9_v1_1": (CUBEMARS, Ranges(12.5, 22.5, 18.0)),
    "ak80_9_v2": (CUBEMARS, Ranges(12.5, 25.64, 18.0)),
    "ak70_10": (CUBEMARS, Ranges(12.5, 50.0, 24.0)),
    "ak10_9": (CUBEMARS, Ranges(12.5, 50.0, 65.0)),
    "ak60_6": (CUBEMARS, Ranges(12.5, 50.0, 15.0)),
    "ak80_64": (CUBEMARS, Ranges(12.5, 8.0, 144.0)),
    "dm4310": (DAMIAO, Ranges(12.5, 30.0, 10.0)),
    "dm4310_48v": (DAMIAO, Ranges(12.5, 50.0, 10.0)),
    "dm4340": (DAMIAO, Ranges(12.5, 8.0, 28.0)),
    "dm4340_48v": (DAMIAO, Ranges(12.5, 10.0, 28.0)),
    "dm6006": (DAMIAO, Ranges(12.5, 45.0, 20.0)),
    "dm8006": (DAMIAO, Ranges(12.5, 45.0, 40.0)),
    "dm8009": (DAMIAO, Ranges(12.5, 45.0, 54.0)),
    "dm10010l": (DAMIAO, Ranges(12.5, 25.0, 200.0)),
    "dm10010": (DAMIAO, Ranges(12.5, 20.0, 200.0)),
    "dmh3510": (DAMIAO, Ranges(12.5, 280.0, 1.0)),
    "dmg62xx": (DAMIAO, Ranges(12.5, 45.0, 10.0)),
}
_TURNS: Final = 12.566370614359172  # 4 pi
ROBSTRIDES: Final[dict[str, tuple[Firmware, Ranges]]] = {
    "cybergear": (ROBSTRIDE, Ranges(_TURNS, 30.0, 12.0)),
    "rs00": (ROBSTRIDE, Ranges(_TURNS, 33.0, 14.0)),
    "rs01": (ROBSTRIDE, Ranges(_TURNS, 44.0, 17.0)),
    "rs04": (ROBSTRIDE, Ranges(_TURNS, 15.0, 120.0, 5000.0, 100.0)),
    "rs05": (ROBSTRIDE, Ranges(_TURNS, 50.0, 5.5)),
}


def _range(unit: str, of: str, plausible: tuple[float, float]) -> Any:
    doc = f"Range of {of}; absent: the model's."
    return positive(None, unit, doc, plausible, most=1e6)


@dataclass(frozen=True, kw_only=True)
class RangesTable(MotorTable):
    """Keys of all drives with impedance control."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Identifier of its requests.", example="1")
    p_max_rad: float | None = _range("rad", "positions, either way", (1.0, 200.0))
    v_max_rad_s: float | None = _range("rad/s", "velocities, either way", (1.0, 1000.0))
    t_max_n_m: float | None = _range("N·m", "torques, either way", (0.1, 1000.0))
    kp_max_n_m_rad: float | None = _range("N·m/rad", "stiffness", (1.0, 1e5))
    kd_max_n_m_s_rad: float | None = _range("N·m·s/rad", "damping", (0.1, 1e3))
    boot_up_s: float = amount(
        0.1, "s", "From power-on to the first answer.", (0.01, 10.0), most=3600
    )
    watchdog_s: float | None = amount(
        *(None, "s", "Longest time between commands; 0: unlimited; absent: the model's."),
        *((0.005, 10.0),),
        most=3600,
    )

    def ranges(self, model: Ranges) -> Ranges:
        """Return the ranges: the model's, or those given."""
        own = (self.p_max_rad, self.v_max_rad_s, self.t_max_n_m)
        gains = (self.kp_max_n_m_rad, self.kd_max_n_m_s_rad)
        pairs = zip((*own, *gains), model, strict=True)
        return Ranges(*(known if given is None else given for given, known in pairs))


@final
@dataclass(frozen=True, kw_only=True)
class MitTable(RangesTable):
    """A drive with MIT frames: mini cheetah, CubeMars AK, Damiao."""

    model: str = word("ak80_6_v2", MODELS, "model", "Its model and firmware edition.")
    master_id: int = whole(0, 0, 0x7FF, "", "Identifier of its answers.")
    answer_bytes: int | None = whole(None, 6, 8, "", "Length of an answer; absent: the model's.")


@final
@dataclass(frozen=True, kw_only=True)
class RobstrideTable(RangesTable):
    """A RobStride or CyberGear drive, with its own extended frames."""

    model: str = word("rs01", ROBSTRIDES, "model", "Its model.")
