"""The pytest plugin, as a project meets it that has motorhil installed and knows nothing else."""

import re
import shlex
import subprocess
import sys

import pytest

import harness.cli
import harness.pytest_rigs  # stays loaded between the runs below
from harness.scaffold import write_new_rig
from tests.harness.rigs import GOOD  # noqa: F401
from traces.digest import digest_of
from traces.reader import read_metadata

pytest_plugins = ["pytester"]
TURN = """
import pytest
from motorapi import ControlMode

def turn(motor, place_rad):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(place_rad)
    motor.start()
    motor.wait_until_done(timeout_s=5)
"""
