"""Hands on a rig: by keyboard in Chromium, over HTTP, and the repetition without hands."""

import json
import os
import signal
import socket

import pytest

from motorhil.harness.cli.main import main
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.view.growing import Events, get, post, served
from tests.support.view.watched import Watched

pytestmark = pytest.mark.wall

RUN = ("run", "wheels/rig.toml", "wheels/drive.py", "--view", "--paused", "-o", "hands.mcap")


def shown(page, text):
    return f"document.querySelector('{page}').textContent.includes({json.dumps(text)})"


def at(browser):
    return float(browser.run("hands.state.at_s"))


def tab_to(browser, name):
    """Press Tab until the element of this id, or with this name, has the focus."""
    script = f"[document.activeElement.id, document.activeElement.ariaLabel].includes({name!r})"
    reached = []
    for _ in range(60):
        browser.key("Tab", code="Tab")
        if browser.run(script):
            return
        reached.append(browser.run("document.activeElement.id"))
    raise AssertionError(f"Tab does not reach {name}: {reached}")


def press(browser, key, code, number, text=""):
    more = {"text": text} if text else {}
    browser.key(key, code=code, windowsVirtualKeyCode=number, **more)


def type_step(browser, text):
    """Write the size of a step [ms]."""
    tab_to(browser, "step-ms")
    for _ in range(4):
        press(browser, "Backspace", "Backspace", 8)
    browser.call("Input.insertText", text=text)


def enter(browser):
    press(browser, "Enter", "Enter", 13, "\r")


def test_keyboard_alone_stops_steps_loads_and_cuts(wheels, page):
    with Watched(*RUN, "--pace", "0.2") as watched:
        one = page(watched)
        one.wait("hands.elements && hands.state.stands")
        one.wait("document.documentElement.dataset.state === 'ready'")
        assert at(one) == 0.0
        type_step(one, "400")
        one.run("document.activeElement.blur()")
        press(one, ".", "Period", 190, ".")
        one.wait("hands.state.at_s === 0.4")
        one.wait("SPAN > 0.35")  # seen although time stands still
        tab_to(one, "left load_torque_n_m")
        one.call("Input.insertText", text="2.5")
        enter(one)
        one.wait(shown("#hand-told", "left: load_torque_n_m = 2.5, at 0.4"))
        one.wait(shown("#list", "stimulus load_torque_n_m = 2.5"))
        one.run("$('element').focus()")
        tab_to(one, "cable")
        enter(one)
        one.wait("hands.state.faults.length === 1")
        assert one.run("$('cable').getAttribute('aria-pressed')") == "true"
        one.wait(shown("#hand-faults", "can0: cut"))
        one.run("$('stand').focus()")
        type_step(one, "20")  # soon the program would take the drive for lost
        one.run("document.activeElement.blur()")
        press(one, ".", "Period", 190, ".")
        one.wait(shown("#list", "left cut off"))
        tab_to(one, "cable")
        enter(one)
        one.wait("hands.state.faults.length === 0")
        one.run("document.activeElement.blur()")
        press(one, "t", "KeyT", 84, "t")
        one.wait("!hands.state.stands")
        press(one, "t", "KeyT", 84, "t")
        one.wait("hands.state.stands")
        assert at(one) > 0.42
        assert one.run("$('stand').getAttribute('aria-pressed')") == "true"
        assert one.run("$('hand-problem').textContent") == ""


def test_refused_act_is_told_on_the_page(wheels, page):
    with Watched(*RUN) as watched:
        one = page(watched)
        one.wait("hands.elements && hands.state.stands")
        one.run("$('element').value = 'bus can0'; $('element').dispatchEvent(new Event('change'))")
        one.run("$('fault-keys').value = 'identifer = 3'")
        one.run("[...document.querySelectorAll('#inputs button')].pop().click()")
        one.wait(shown("#hand-problem", "identifer: unknown key"))
        assert one.run("hands.state.acts") == 0
        assert one.run("$('fault-kind').options.length") == 10
        (told,) = one.errors
        assert "400 (Bad Request)" in told
        one.errors.clear()
        one.size(320, 640)
        one.settle()
        assert one.run("document.documentElement.scrollWidth") <= 320


def test_hands_have_names_for_a_screen_reader(wheels, page):
    with Watched(*RUN) as watched:
        one = page(watched)
        one.wait("hands.elements && $('cable')")
        tree = one.call("Accessibility.getFullAXTree")["nodes"]
    names = {
        (node["role"]["value"], node.get("name", {}).get("value", ""))
        for node in tree
        if not node.get("ignored")
    }
    wanted = {
        ("button", "stop time"),
        ("button", "step"),
        ("combobox", "act on"),
        ("slider", "left load_torque_n_m, slider"),
        ("spinbutton", "left device_temperature_c"),
        ("button", "cut the cable"),
        ("button", "sto"),
        ("combobox", "home"),
    }
    assert wanted - names == set()
    controls = {"button", "combobox", "slider", "spinbutton", "textbox", "searchbox"}
    assert {role for role, name in names if role in controls and not name} == set()


def acts_by_hand(watched):
    """Act on the wheels while they turn; return the time of the last act."""
    acts = [
        {"act": "step", "for_s": 0.35},
        {"act": "stimulus", "controller": "left", "name": "load_torque_n_m", "value": 3.3},
        {"act": "step", "for_s": 0.1},
        {"act": "fault", "bus": "can0", "kind": "cut", "keys": 'nodes = ["right"]'},
        {"act": "step", "for_s": 0.3},
        {"act": "mend", "name": "hand 2"},
        {"act": "fault", "bus": "can0", "kind": "noise", "keys": "bit_error_rate = 1e-4"},
        {"act": "pace", "pace": 0.5},
        {"act": "continue"},
        {"act": "stimulus", "controller": "left", "name": "load_torque_n_m", "value": 0.1},
        {"act": "stimulus", "controller": "right", "name": "device_temperature_c", "value": 60.0},
        {"act": "fault", "bus": "can0", "kind": "drop", "keys": 'sender = "left", limit = 1'},
        {"act": "pace"},
    ]
    for act in acts:
        assert watched.act(**act) == (200, "done")


@pytest.mark.parametrize("further", [(), ("--pace", "30")])
def test_recording_repeats_without_hands(wheels, capfd, further):
    with Watched(*RUN, *further) as watched:
        acts_by_hand(watched)
        told = watched.line("7 acts by hand; without hands: ")
        watched.line("the run is over")
        assert watched.act(act="stop") == (400, "rig: the run is over")
        assert watched.interrupted()[0] == 0
    words = told.split("motorhil ")[1].split()
    assert main([*words, "-o", "again.mcap"]) == 0
    assert digest("again.mcap") == digest("hands.mcap")
    assert main([*words[:5], "-o", "plain.mcap"]) == 0
    assert digest("plain.mcap") != digest("hands.mcap")
    capfd.readouterr()
    assert main(["show", "hands.mcap", "--hands"]) == 0
    (wheels / "hands.toml").write_text(capfd.readouterr().out)
    assert main([*words[:5], "--world", "hands.toml", "-o", "third.mcap"]) == 0
    assert digest("third.mcap") == digest("hands.mcap")
    assert main([*words[:3], "--world", "again.mcap", "-o", "fourth.mcap"]) == 0
    assert digest("fourth.mcap") == digest("hands.mcap")  # a repetition repeats


def test_acts_are_in_the_record_with_their_instants(wheels):
    with Watched(*RUN) as watched:
        watched.act(act="step", for_s=0.35)
        watched.act(act="stimulus", controller="left", name="load_torque_n_m", value=1.0)
        watched.act(act="fault", bus="can0", kind="cut", keys='nodes = ["left"]')
        watched.act(act="step", for_s=0.35)
    with read_trace("hands.mcap") as trace:  # although the run was killed
        assert "at_s = 0.35\n" in trace.metadata["hand 1"]["toml"]
        assert "from_s = 0.350000001\n" in trace.metadata["hand 2"]["toml"]


def test_foreign_requests_are_refused(wheels):
    with Watched(*RUN) as watched:
        port, path, act = watched.port, f"/hands?token={watched.token}", {"act": "step"}
        assert post(port, "/hands?token=wrong", act)[0] == 403
        assert post(port, "/hands", act)[0] == 403
        assert post(port, path, act, Host=f"evil.example:{port}")[0] == 403
        assert post(port, path, act, Origin="http://evil.example")[0] == 403
        assert post(port, path, act, Origin="null")[0] == 403
        assert post(port, path, act, Content_Type="text/plain")[0] == 415
        assert post(port, path, b" " * 2_049)[0] == 413
        assert post(port, path, b"[")[0] == 400
        assert post(port, path, b"[]")[0] == 400
        assert post(port, f"/other?token={watched.token}", act)[0] == 404
        assert get(port, "/hands?token=wrong")[0] == 403
        own = f"http://127.0.0.1:{port}"
        assert post(port, path, act, Origin=own)[::2] == (200, b"done")


def test_view_of_a_rig_has_the_same_hands(wheels, capsys):
    words = ("view", "wheels/rig.toml", "wheels/drive.py", "--paused", "--pace", "50")
    with Watched(*words) as watched:
        assert watched.act(act="stimulus", controller="left", name="home", value=1) == (200, "done")
        assert watched.act(act="continue") == (200, "done")
        watched.line("1 act by hand; -o FILE keeps them in a recording")
        watched.line("the run is over")
        assert watched.interrupted()[0] == 0
    assert main(["run", "wheels/rig.toml", "wheels/drive.py", "--paused"]) == 2
    assert "--paused needs a page that lets time pass; add --view" in capsys.readouterr().err
    assert main(["view", "hands.mcap", "--paused"]) == 2
    assert "is not a rig file; --paused is for a rig's time" in capsys.readouterr().err


def test_file_has_no_hands(demo):
    with served(demo) as server:
        assert post(server.port, "/hands?token=t0ken", {"act": "stop"})[0] == 404
        assert get(server.port, "/hands?token=t0ken")[0] == 404


def test_page_that_leaves_in_a_drag_does_not_stop_the_rig(wheels):
    words = [word for word in RUN if word != "--paused"]
    body = b'{"act": "stimulus", "controller": "left", "name": "load_torque_n_m", "value": '
    with Watched(*words, "--pace", "20") as watched:
        with Events(watched.port, token=watched.token) as events:
            events.next()
            for value in range(20):
                with socket.create_connection(("127.0.0.1", watched.port)) as one:
                    data = body + str(value / 10).encode() + b"}"
                    size = len(data) + (value % 2) * 10  # each second one breaks off
                    head = (
                        f"POST /hands?token={watched.token} HTTP/1.1\r\nContent-Length: {size}\r\n"
                    )
                    head += (
                        f"Host: 127.0.0.1:{watched.port}\r\nContent-Type: application/json\r\n\r\n"
                    )
                    one.sendall(head.encode() + data)
        watched.line("the run is over")
        status, out = watched.interrupted()
    assert status == 0
    assert "right is at" in out


def test_rig_continues_after_its_page_server_has_ended(wheels):
    with Watched(*RUN) as watched:
        (server,) = children(watched.pid)
        os.kill(server, signal.SIGKILL)
        watched.line("the run is over")


def children(pid):
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(word) for word in file.read().split()]


def test_interrupt_ends_a_rig_whose_time_stands_still(wheels):
    with Watched(*RUN) as watched:
        watched.act(act="step", for_s=0.2)
        assert watched.interrupted()[0] == 130
    with read_trace("hands.mcap") as trace:
        assert trace.cut is None
