"""A scenario with all commands of an axis, and its digest.

The digest is the same on every machine, compiled or not.
"""

from hashlib import sha256

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import PLAUSIBLE

MS = 1_000_000


def digest() -> str:
    """Return the SHA-256 over every tick's readings, in full precision."""
    total = sha256()
    for name, plant in PLAUSIBLE.items():
        axis = Axis(plant, ServoGains.tuned(plant, MS, 10), MS, 10)
        for k in range(6_000):
            axis.at(k * MS)
            command(axis, k)
            readings = (
                *(name, axis.flags, axis.position_inc(), axis.demand_inc()),
                *(axis.velocity_inc_s(), axis.demand_velocity_inc_s(), axis.current_a()),
                *(axis.output_position_rad(), axis.output_velocity_rad_s(), axis.torque_n_m()),
            )
            total.update(repr(readings).encode())
            if k % 7 == 0:
                axis.next_event_ns()
    return total.hexdigest()


def command(axis: Axis, k: int) -> None:
    """Give every command once, and reach the limits of voltage and current."""
    if k == 10:
        axis.power(True)
    elif k == 100:
        axis.move_to(50_000, 120_000.0, 700_000.0, 500_000.0)
    elif k == 400:
        axis.set_load(1.0)
    elif k == 1_000:
        axis.move_to(-20_000, 1e6, 1e8, 1e8)
    elif k == 2_000:
        axis.set_position(0)
        axis.run_at(-60_000.0, 300_000.0, 300_000.0)
    elif k == 2_800:
        axis.ramp_to_rest(2e6)
    elif 3_200 <= k < 3_400:
        axis.follow(axis.target_inc() + (k % 40), MS)
    elif k == 3_500:
        axis.set_current_limit(0.6)
        axis.move_to(3_000, 50_000.0, 1e6, 1e6)
    elif k == 4_500:
        axis.hold()
    elif k == 5_000:
        axis.power(False)
    elif k == 5_200:
        axis.power(True)
        axis.apply_current(0.4, 3.0)
    elif k == 5_400:
        axis.run_at(5_000.0, 300_000.0, 300_000.0)
    elif k == 5_600:
        axis.apply_current(-0.5, 1e9)
    elif k == 5_700:
        axis.move_to(0, 60_000.0, 1e6, 1e6)


if __name__ == "__main__":
    print(digest())
