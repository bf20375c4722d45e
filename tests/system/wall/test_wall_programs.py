"""Programs beside a world in wall time, and signals."""

import gc
import os
import signal

import pytest

from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.cli.processes import Program, StopSignals

pytestmark = pytest.mark.wall


@pytest.fixture
def loop():
    loop = WallLoop(EventQueue())
    gc.collect()  # remains of earlier tests do not count
    before = set(os.listdir("/proc/self/fd"))
    yield loop
    assert set(os.listdir("/proc/self/fd")) - before == set()  # nothing was left open
    loop.close()


@pytest.fixture
def start(loop, tmp_path):
    """Start a program of these lines."""

    def start_it(*lines):
        path = tmp_path / "waiting_program.py"
        path.write_text("\n".join(("import os, signal, sys", *lines)))
        return Program(path, os.environ, loop)

    return start_it


def heard_until(loop, program, done):
    heard = []

    def is_done():
        heard.extend(program.lines())
        return done(heard)

    loop.run(is_done)
    return heard


def test_endless_program_ends_with_the_block(loop, start):
    with start("print('up', flush=True)", "while True: signal.pause()") as program:
        assert program.name == "waiting"
        assert os.getpgid(program.pid) == program.pid  # Ctrl-C is for us only
        assert heard_until(loop, program, bool) == ["up"]
        assert program.status is None
    assert program.status == -signal.SIGKILL
    with pytest.raises(ProcessLookupError):
        os.kill(program.pid, 0)


def test_output_is_read_and_program_end_wakes_the_loop(loop, start):
    lines = (
        "print('one')",
        "print('two', file=sys.stderr)",
        "sys.stdout.flush()",
        "os.write(1, b'th\\xffree')",
        "sys.exit(3)",
    )
    with start(*lines) as program:
        heard = heard_until(loop, program, lambda heard: program.status is not None)
        heard += program.lines() + program.lines()
        assert sorted(heard) == ["one", "th\N{REPLACEMENT CHARACTER}ree", "two"]
        assert program.status == 3
        program.kill()  # as if nothing had happened
    assert program.status == 3


def test_signal_is_kept_and_its_handler_restored(loop):
    before = signal.getsignal(signal.SIGTERM)
    with StopSignals(loop) as signals:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        loop.run(lambda: signals.number is not None)
        assert signals.number == signal.SIGTERM
    loop.step(0.0)  # it continues without
    assert signal.getsignal(signal.SIGTERM) is before


def test_ignored_hang_up_stays_ignored(loop):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals(loop, (signal.SIGHUP,)) as signals:
            signal.raise_signal(signal.SIGHUP)
            loop.step(0.0)
            assert signals.number is None
    finally:
        signal.signal(signal.SIGHUP, before)
