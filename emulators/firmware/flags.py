"""What an axis says about itself in one int; each bit is exact to the servo tick."""

from typing import Final

POWERED: Final = 1  # the power stage drives current
PROFILE_ACTIVE: Final = 2  # a commanded move or ramp has not reached its end yet
IN_TARGET_WINDOW: Final = 4  # profile over, actual within the target window long enough
FOLLOWING_ERROR: Final = 8  # |following error| beyond its window too long; not latched
SPEED_ZERO: Final = 16  # |velocity| within its threshold long enough
IN_VELOCITY_WINDOW: Final = 32  # run_at only: actual within the window of the wanted velocity
CURRENT_SATURATED: Final = 64  # the velocity loop asks for more current than is allowed
CURRENT_REACHED: Final = 128  # apply_current only: ramp over, current near the one wanted
OUTSIDE_GATE: Final = 256  # a count has left the range set_gate named; with power or without
