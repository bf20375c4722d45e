"""Rigs of the plugins in bench.py, and a script for them."""

GOOD = """\
[rig]
seed = 7
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.left]
kind = "echo"
bus = "can0"
node_id = 1
plant.resistance_ohm = 1.5
[controller.right]
kind = "echo"
bus = "can0"
node_id = 2
[motor.left]
adaptation = "bare"
controller = "left"
[motor.left.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
[motor.right]
adaptation = "bare"
controller = "right"
model = "wheel.toml"
"""
WHEEL = """\
velocity_max_rad_s = 5.0
acceleration_max_rad_s2 = 20.0
current_max_a = 4.0
increments_per_rad = 10185.9163
"""

FAULT = '[[fault]]\nname = "loss"\nbus = "can0"\nkind = "drop"\nidentifier = 0x181\n'

SCRIPT = """\
import sys
import can

with can.Bus() as bus:
    bus.send(can.Message(arbitration_id=0x101, data=[42], is_extended_id=False))
    heard = [bus.recv(1.0) for _ in range(3)]
print(sys.argv[1:], __name__, heard[2].data.hex())
"""
