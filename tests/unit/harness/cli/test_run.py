import os
import signal
import subprocess
import sys
import time

import pytest

from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.command_line import beside, environment, in_another_process
from tests.support.plugin_rigs import SCRIPT


def test_script_joins_rig_with_plain_can_bus(rig, say):
    assert say("run", "rig.toml", "script.py") == (0, "[] __main__ 2a\n", "")


def test_script_leaves_no_trace_in_process(rig, say, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CONFIG", '{"fd": true}')
    before = (dict(os.environ), sys.argv, sys.path.copy(), sys.modules["__main__"])
    assert say("run", "rig.toml", "script.py") == (0, "[] __main__ 2a\n", "")
    assert (dict(os.environ), sys.argv, sys.path, sys.modules["__main__"]) == before


def test_options_stand_anywhere_before_two_dashes(rig, say):
    expected = (0, "['a', '--seed', '--', 'b'] __main__ 2a\n", "")
    words = ("--seed", "3", "rig.toml", "script.py", "a", "--", "--seed", "--", "b")
    assert say("run", *words) == expected
    words = ("rig.toml", "script.py", "--seed=3", "a", "--", "--seed", "--", "b")
    assert say("run", *words) == expected


@pytest.mark.parametrize(
    ("line", "status", "told"),
    [
        ("sys.exit()", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("sys.exit('enough')", 1, "enough\n"),
    ],
)
def test_exit_status_is_that_of_script(rig, say, line, status, told):
    (rig / "script.py").write_text(f"import sys\n{line}\n")
    again = "again: motorhil run rig.toml script.py --seed 7\n" if status else ""
    assert say("run", "rig.toml", "script.py") == (status, "", told + again)


def test_traceback_begins_at_script(rig, say):
    (rig / "helper.py").write_text("def divide(a, b):\n    return a / b\n")
    (rig / "script.py").write_text("import helper\n\nhelper.divide(1, 0)\n")
    status, out, err = say("run", "rig.toml", "script.py", "-o", "x.mcap", "--", "a b")
    assert (status, out) == (1, "")
    assert without_marks(err) == [
        "Traceback (most recent call last):",
        '  File "script.py", line 3, in <module>',
        "    helper.divide(1, 0)",
        f'  File "{rig}/helper.py", line 2, in divide',
        "    return a / b",
        "ZeroDivisionError: division by zero",
        "again: motorhil run rig.toml script.py --seed 7 -o x.mcap -- 'a b'",
    ]


def without_marks(traceback):
    """Return the lines except those that mark columns, which depend on the version of Python."""
    return [line for line in traceback.splitlines() if line.strip(" ~^")]


def test_traceback_ends_before_motor_interface(rig, say):
    (rig / "script.py").write_text(
        "import can\nfrom motorhil.motorapi import runtime_of\nbus = can.Bus()\n"
        "runtime_of(bus).wait_until(lambda: False, -1.0)\n"
    )
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    *places, problem, _ = without_marks(err)
    assert places == [
        "Traceback (most recent call last):",
        '  File "script.py", line 4, in <module>',
        "    runtime_of(bus).wait_until(lambda: False, -1.0)",
    ]
    assert problem.startswith("motorhil.motorapi.errors.UsageError: timeout_s = -1.0")


def test_unhandled_error_of_party_fails_script(rig, say):
    (rig / "script.py").write_text(
        "import can\nfrom motorhil.motorapi import runtime_of\nwith can.Bus() as bus:\n"
        "    runtime = runtime_of(bus)\n    runtime.spawn('second', lambda: 1 / 0)\n"
        "    runtime.wait_until(lambda: False, 1.0)\n"
    )
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    lines = err.splitlines()
    assert lines[:2] == [
        "Traceback (most recent call last):",
        '  File "script.py", line 5, in <lambda>',
    ]
    assert "ZeroDivisionError: division by zero" in lines
    assert lines[-1].startswith("again: motorhil run")


def test_records_of_one_seed_are_equal_for_any_hash_seed(bench, say):
    say("new", ".")
    digests = []
    for hash_seed in ("0", "1"):
        target = f"{hash_seed}.mcap"
        done = subprocess.run(
            [sys.executable, "-m", "motorhil", "run", "rig.toml", "drive.py", "-o", target],
            env={**environment(), "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            timeout=120,
            check=True,
        )
        assert b"right is at 3.1416" in done.stdout
        digests.append(digest(target))
    assert digests[0] == digests[1]


def test_syntax_error_of_script_is_reported_as_by_python(rig, say):
    (rig / "script.py").write_text("a = = 1\n")
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    assert err.startswith('  File "script.py", line 1\n')
    assert "SyntaxError: invalid syntax" in err


def test_chained_errors_of_script_are_all_reported(rig, say):
    (rig / "script.py").write_text("try:\n    1/0\nexcept Exception as e:\n    raise KeyError(1)\n")
    _, _, err = say("run", "rig.toml", "script.py")
    assert err.index("ZeroDivisionError") < err.index("During handling") < err.index("KeyError: 1")
    assert "harness" not in err


def test_script_is_read_from_standard_input(rig):
    done = in_another_process("run", "rig.toml", "-", "a", input=SCRIPT)
    assert (done.returncode, done.stdout) == (0, "['a'] __main__ 2a\n")
    done = in_another_process("run", "rig.toml", "-", input="x = 1\nx / 0\n")
    assert done.returncode == 1
    assert '  File "<stdin>", line 2, in <module>\n    x / 0\n' in done.stderr


def test_prompt_without_script_has_rig(rig):
    lines = "rig.seed + 35\nrig.runtime.run_for(2.5); rig.runtime.now_ns()\nexit(3)\n"
    done = in_another_process("run", "rig.toml", input=lines)
    assert done.returncode == 3
    assert "42" in done.stdout
    assert "2500000000" in done.stdout
    assert "rig: motors left, right; time passes while you wait" in done.stderr
    assert in_another_process("run", "rig.toml", input="").returncode == 0


@pytest.mark.wall
def test_ctrl_c_ends_script_with_130_and_one_line(rig):
    (rig / "script.py").write_text(
        "from motorhil.motorapi import runtime_of\nimport can\nwith can.Bus() as bus:\n"
        "    print('up', flush=True)\n    runtime_of(bus).wait_until(lambda: False, 3600.0)\n"
    )
    with beside("run", "--realtime", "rig.toml", "script.py") as process:
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "motorhil: interrupted\n"


def test_closed_output_is_not_an_error(rig):
    (rig / "script.py").write_text("for n in range(100_000): print('line', n)\n")
    command = f"{sys.executable} -m motorhil run rig.toml script.py | head -n 1"
    done = subprocess.run(
        command, shell=True, env=environment(), capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.stderr) == ("line 0\n", "")


def test_unfinished_record_is_reported_in_one_line(rig):
    (rig / "script.py").write_text(
        "from motorhil.motorapi import runtime_of\nimport can\nwith can.Bus() as bus:\n"
        "    task = bus.send_periodic(can.Message(arbitration_id=1), 0.0005)\n"
        "    runtime_of(bus).wait_until(lambda: False, 10.0)\n"
    )
    command = f"ulimit -f 8; {sys.executable} -m motorhil run rig.toml script.py -o x.mcap"
    done = subprocess.run(
        ["bash", "-c", command], env=environment(), capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2
    assert done.stderr.startswith("x.mcap: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.wall
def test_realtime_takes_wall_time(rig, say):
    (rig / "script.py").write_text(
        "from motorhil.motorapi import runtime_of\nimport can\n"
        "runtime_of(can.Bus()).wait_until(lambda: False, 0.1)\n"
    )
    start_s = time.monotonic()
    assert say("run", "--realtime", "rig.toml", "script.py") == (0, "", "")
    assert time.monotonic() - start_s >= 0.1


# --- threads of a script

PLAIN_THREAD = """\
import threading
import can

bus = can.Bus()
bus.shutdown()
bus = can.Bus()


def listen():
    bus.recv(1.0)


thread = threading.Thread(target=listen, name="listener")
thread.start()
thread.join()
bus.shutdown()
"""


def test_thread_of_script_waits_in_virtual_time(rig, say):
    (rig / "script.py").write_text(PLAIN_THREAD + "print(bus.runtime.now_ns())\n")
    assert say("run", "rig.toml", "script.py") == (0, "56000\n", "")  # a boot-up message


def test_rig_stays_open_until_script_threads_end(rig, say):
    (rig / "script.py").write_text(
        "import sys, threading\nimport can\nbus = can.Bus()\nmain_ended = threading.Event()\n"
        "sys.modules['__main__'].ended = main_ended\n"
        "def watch():\n    main_ended.wait(20)\n    print(bus.runtime.now_ns())\n    1 / 0\n"
        "threading.Thread(target=watch).start()\n"
        "threading.Timer(0.2, main_ended.set).start()\n"
    )
    status, out, err = say("run", "rig.toml", "script.py")
    assert status == 1
    assert 200_000_000 <= int(out) < 200_010_000  # a waiting thread has looked at the clock before
    assert "ZeroDivisionError" in err


def test_frame_sent_at_the_end_of_script_is_recorded(rig, say):
    """As the kernel sends what a program has left in the queue of an interface."""
    (rig / "script.py").write_text(
        "import can\n"
        "with can.Bus() as bus:\n"
        "    bus.send(can.Message(arbitration_id=0x123, is_extended_id=False))\n"
    )
    assert say("run", "rig.toml", "script.py", "-o", "run.mcap") == (0, "", "")
    _, out, _ = say("show", "run.mcap")
    assert "123" in out


def test_deadlocked_threads_are_reported_with_name_and_line(rig, say):
    (rig / "script.py").write_text(
        "import threading\nthreading.Thread(target=threading.Event().wait, name='idle').start()\n"
    )
    status, out, err = say("run", "rig.toml", "script.py")
    assert (status, out) == (1, "")
    told = "script.py has ended, but its thread 'idle' still runs; Ctrl-C ends it"
    assert err.splitlines()[0] == told
    assert "party 'idle' waits without a timeout, but nothing can end the wait" in err
    assert "(waiting: idle" in err


def test_atexit_functions_run_while_rig_is_open(rig, say):
    (rig / "script.py").write_text(
        "import atexit, threading, time\nimport can\nbus = can.Bus()\n"
        "atexit.register(bus.shutdown)\n\n"
        "def bye(word):\n    time.sleep(1)\n    print(word, bus.runtime.now_ns() // 10**9)\n\n"
        "atexit.register(bye, 'good')\natexit.register(lambda: 1 / 0)\natexit.register(exit)\n"
        "atexit.unregister(exit)\n"
        "threading.Timer(2.0, print, ['thread']).start()\n"
    )
    status, out, err = say("run", "rig.toml", "script.py")
    assert (status, out) == (0, "thread\ngood 3\n")
    assert err.splitlines()[-1] == "ZeroDivisionError: division by zero"


@pytest.mark.wall
def test_ctrl_c_ends_script_with_endless_thread(rig):
    (rig / "script.py").write_text(
        "import threading, time\n\ndef idle():\n    while True:\n        time.sleep(1)\n\n"
        "threading.Thread(target=idle, name='idle').start()\n"
    )
    with beside("run", "rig.toml", "script.py") as process:
        told = [process.stderr.readline()]
        if told[0].startswith("motorhil run: virtual time has reached"):  # seen once a second
            told = [process.stderr.readline()]
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    told += [one for one in err.splitlines(True) if "virtual time has reached" not in one]
    assert told == [
        "script.py has ended, but its thread 'idle' still runs; Ctrl-C ends it\n",
        "motorhil: interrupted\n",
    ]
    assert process.returncode == 130


CALLBACK = """\
import can

bus = can.Bus()


def act():
    {act}


bus.runtime.every(0.1, act)
try:
    bus.runtime.run_for(1.0)
finally:
    bus.shutdown()
"""


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (
            "bus.recv(1.0)",
            "motorhil.motorapi.errors.UsageError: waiting inside a callback: time stands",
        ),
        ("1 / 0", "ZeroDivisionError: division by zero"),
    ],
)
def test_callback_error_is_reported_with_script_lines(rig, say, act, told):
    (rig / "script.py").write_text(CALLBACK.format(act=act))
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    lines = [line for line in err.splitlines() if not set(line) <= set(" ^~")]
    assert lines[:5] == [
        "Traceback (most recent call last):",
        '  File "script.py", line 12, in <module>',
        "    bus.runtime.run_for(1.0)",
        '  File "script.py", line 7, in act',
        f"    {act}",
    ]
    assert lines[5].startswith(told)


def test_prompt_traceback_has_only_user_lines(rig):
    lines = (
        "rig.runtime.wait_until(lambda: False, -1.0)\n"
        "rig.motors['lift']\n"
        "rig.runtime.every(0.1, lambda: 1 / 0)\n"
        "rig.runtime.run_for(1.0)\n"
        "a = = 1\n"
    )
    done = in_another_process("run", "rig.toml", input=lines)
    assert done.returncode == 0
    told = done.stderr.splitlines()[1:]
    where = '  File "<console>", line 1, in <module>'
    assert told[:2] == ["Traceback (most recent call last):", where]
    assert told[2].startswith(
        "motorhil.motorapi.errors.UsageError: timeout_s = -1.0: must be a number"
    )
    assert told[3:5] == ["Traceback (most recent call last):", where]
    error, _, text = told[5].partition(": ")
    assert error == "motorhil.harness.rig.names.NoSuchName"
    assert text == "this rig has no motor 'lift' (known: left, right)"
    assert told[6:10] == [
        "Traceback (most recent call last):",
        where,
        '  File "<console>", line 1, in <lambda>',
        "ZeroDivisionError: division by zero",
    ]
    assert "SyntaxError: invalid syntax" in told[-2:]


ENDLESS = """
import can
with can.Bus() as bus:
    try:
        for message in bus:
            pass
    finally:
        print("ended")
"""


def test_until_ends_an_endless_script_as_ctrl_c_would(rig, say, interruptible):
    (rig / "script.py").write_text(ENDLESS)
    assert say("run", "rig.toml", "script.py", "--until", "2.5", "-o", "x.mcap") == (
        *(0, "ended\n"),
        "",
    )
    with read_trace("x.mcap") as trace:
        assert trace.span_ns()[1] <= 2_500_000_000


def test_until_ends_a_script_that_goes_on_after_ctrl_c(rig, say):
    again = (
        "try:\n    while True: time.sleep(1)\nexcept KeyboardInterrupt:\n    print(time.time())\n"
    )
    (rig / "script.py").write_text(f"import time\n{again}{again}")
    assert say("run", "rig.toml", "script.py", "--until", "2.5")[0] == 0


def test_rig_and_script_in_the_wrong_order_are_told(rig, say):
    assert say("run", "script.py", "rig.toml") == (
        *(2, ""),
        "script.py: is a Python program, not a rig; name the rig first: run RIG SCRIPT\n",
    )


def test_script_with_its_own_rig_is_told_how_it_is_run(rig, say):
    (rig / "script.py").write_text("from motorhil import Rig\nwith Rig.open('rig.toml'): pass\n")
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    assert "a program that opens its own rig is run by python, not by motorhil run" in err


REPLACED = """\
import can
with can.Bus(interface={interface!r}, channel={channel!r}) as bus:
    print(repr(bus.recv(1.0).channel))
"""


@pytest.mark.parametrize(
    ("interface", "channel"), [("socketcan", "can0"), ("socketcan", 0), ("slcan", "/dev/can0")]
)
def test_messages_have_the_channel_of_the_replaced_bus(tmp_path, say, interface, channel):
    """The boot-up of the drive arrives; the bus of the rig is can0."""
    (tmp_path / "rig.toml").write_text(DRIVE)
    program = tmp_path / "program.py"
    program.write_text(REPLACED.format(interface=interface, channel=channel))
    status, out, err = say("run", str(tmp_path / "rig.toml"), str(program))
    assert (status, out) == (0, f"{channel!r}\n"), err


DRIVE = """\
bus.can0.bitrate_bit_s = 1_000_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
"""


@pytest.mark.parametrize(
    "body",
    [
        "import time\ntime.sleep(6)\n",
        # The program handles the error itself.
        "import time\nfor _ in range(6):\n    try:\n        time.sleep(1)\n"
        "    except Exception:\n        pass\n",
        # A thread of a library meets it first.
        "import canopen, time\nnetwork = canopen.Network()\nnetwork.connect()\n"
        "network.send_periodic(0x701, b'5', 0.01)\ntime.sleep(6)\n",
        "import threading, time\nthreading.Thread(target=time.sleep, args=(6,)).start()\n",
    ],
    ids=["main", "handled", "canopen", "thread"],
)
@pytest.mark.parametrize("room", [3_000, 12_000])
def test_full_disk_is_reported_once_with_what_was_saved(tmp_path, body, room):
    moving = DRIVE + 'objects = { "1017h" = 10 }\n'  # a heartbeat every 10 ms
    (tmp_path / "rig.toml").write_text(moving)
    (tmp_path / "program.py").write_text(body)
    path = tmp_path / "full.mcap"
    limited = (
        "import resource, sys; from motorhil.harness.cli.main import main;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}));"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ["run", str(tmp_path / "rig.toml"), str(tmp_path / "program.py"), "-o", str(path)]
    done = subprocess.run(
        [sys.executable, "-c", limited, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "motorhil.traces" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if str(path) in line]
    with read_trace(path) as trace:
        last_ns = max((time_ns for _, time_ns, _ in trace.messages()), default=None)
    saved = "nothing yet" if last_ns is None else f"up to {last_ns / 1e9:.3f} s"
    assert line == (
        f"{path}: cannot be written: file too large; the recording holds {saved}; "
        "free space there, or record to another place"
    )
