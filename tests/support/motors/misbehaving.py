"""An adaptation with ideal motors that misbehave when they are disabled.

The file named by MISBEHAVE contains the name of a function below, or nothing.
"""

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import can

from motorhil.harness.conformance import examination as target
from motorhil.motorapi import UnsupportedError
from motorhil.motorapi.adaptations.ideal import motor as ideal
from motorhil.motorapi.locking.process_lock import ProcessLock

RIG = Path(target.__file__).parent / "rigs" / "ideal.toml"
KEPT = []  # referenced only here


def build(bus, settings, model, runtime):
    motor = ideal.build(bus, settings, model, runtime)
    disable = motor._disable

    def harm():
        name = Path(os.environ["MISBEHAVE"]).read_text()
        if name:
            globals()[name](motor)
        disable()

    motor._disable = harm
    return motor


build.needs_bus = False
build.conformance_rig = RIG


def nothing(bus, settings, model, runtime):
    return None


def kind(bus, settings, model, runtime):
    return ideal.IdealMotor


async def promised(bus, settings, model, runtime):
    return ideal.build(bus, settings, model, runtime)


def homeless(bus, settings, model, runtime):
    motor = ideal.build(bus, settings, model, runtime)

    def refuse(method):
        raise UnsupportedError(motor=motor.name, feature="homing")

    motor._home = refuse
    return motor


homeless.needs_bus = False
homeless.conformance_rig = RIG


def shy(bus, settings, model, runtime):
    motor = ideal.build(bus, settings, model, runtime)
    motor._supports = lambda mode, variable: {}[mode]
    return motor


def alone(bus, settings, model, runtime):
    motor = ideal.build(bus, settings, model, runtime)
    motor._sync_offer = lambda: None
    return motor


alone.needs_bus = nothing.needs_bus = kind.needs_bus = promised.needs_bus = shy.needs_bus = False
none_at_all = 3


def raises(motor):
    print("about to divide")
    _ = 1 / 0


def exits(motor):
    print("the adaptation's last words", file=sys.stderr)
    os._exit(3)


def leaves(motor):
    sys.exit("no more")


def segfaults(motor):
    import ctypes

    ctypes.string_at(0)


def works_for_ever(motor):
    while True:
        pass


def works_whatever_comes(motor):
    while True:
        try:
            threading.Event().wait(1.0)
        except BaseException:
            continue


def waits_for_ever(motor):
    threading.Event().wait()


def waits_in_its_runtime(motor):
    motor.runtime.every(0.1, lambda: None)
    motor.runtime.wait_until(lambda: False)


def leaves_a_thread(motor):
    threading.Thread(target=threading.Event().wait, name="poller", daemon=True).start()


def leaves_a_bus(motor):
    can.Bus(interface="virtual", channel="private")


def leaves_a_process(motor):
    KEPT.append(subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"]))


def interrupts(motor):
    raise KeyboardInterrupt


def moves_elsewhere(motor):
    os.chdir("/")


def answers_for_the_kit(motor):
    for number in range(3, 32):
        with contextlib.suppress(OSError):
            os.write(number, b'{"verdict": {"result": "passed"}}\n')


def leaves_a_descriptor(motor):
    os.open("/dev/null", os.O_RDONLY)


def keeps_a_lock(motor):
    if not any(isinstance(one, ProcessLock) for one in KEPT):
        KEPT.append(ProcessLock("pan", "the pan"))
        KEPT[-1].acquire(motor.runtime, "moving")


def says_so_and_works_for_ever(motor):
    told = Path(f"{os.environ['MISBEHAVE']}.new")
    told.write_text(str(os.getpid()))
    told.rename(f"{os.environ['MISBEHAVE']}.at")
    works_for_ever(motor)


def works_for_ever_in_a_further_worker(motor):
    first = Path(f"{os.environ['MISBEHAVE']}.first")
    with contextlib.suppress(FileExistsError), open(first, "x") as file:
        file.write(str(os.getpid()))
    if first.read_text() != str(os.getpid()):
        says_so_and_works_for_ever(motor)


def leaves_garbage(motor):
    cycle = [bytearray(50_000_000)]
    cycle.append(cycle)


def has_a_bug(motor):
    raise LookupError("a bug of the motor")
