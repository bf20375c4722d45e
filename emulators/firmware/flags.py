"""The flags of an axis; each bit is exact to the servo tick."""

from typing import Final

POWERED: Final = 1  # the power stage drives current
PROFILE_ACTIVE: Final = 2  # a commanded move or ramp has not reached its end yet
IN_TARGET_WINDOW: Final = (
    4  # profile finished, and actual position within the target window long enough
)
FOLLOWING_ERROR: Final = 8  # |following error| beyond its window too long; not latched
SPEED_ZERO: Final = 16  # |velocity| within its threshold long enough
IN_VELOCITY_WINDOW: Final = 32  # run_at only: actual velocity within the window around its target
CURRENT_SATURATED: Final = 64  # the current demand exceeds the limit
CURRENT_REACHED: Final = 128  # apply_current only: ramp finished, current near its target
OUTSIDE_GATE: Final = 256  # a count is outside the range of set_gate; with or without power
SPEED_EXCEEDED: Final = 512  # |velocity| beyond the threshold of SPEED_ZERO long enough
# Nonlinear plants only, with or without power; not latched (see Axis.set_thresholds).
OVER_VOLTAGE: Final = 1 << 16  # the DC link is above its threshold
UNDER_VOLTAGE: Final = 1 << 17  # the DC link is below its threshold
OVER_TEMPERATURE: Final = 1 << 18  # the winding has reached its limit
TEMPERATURE_WARNING: Final = 1 << 19  # the winding has reached the temperature to warn at
I2T_LIMIT: Final = 1 << 20  # the I2t integrator is full
I2T_WARNING: Final = 1 << 21  # the I2t integrator has reached its warning level
AT_STOP: Final = 1 << 22  # the load touches an end stop
OF_EXTRAS: Final = (
    OVER_VOLTAGE
    | UNDER_VOLTAGE
    | OVER_TEMPERATURE
    | TEMPERATURE_WARNING
    | I2T_LIMIT
    | I2T_WARNING
    | AT_STOP
)
