"""The desk of a page's server: requests to the rig, and its answers."""

import json
import threading

import pytest

from motorhil.harness.view.desk import WAITING_MAX, Desk


class Rig:
    """A rig that answers each request at once, or never."""

    def __init__(self, problem=""):
        self.problem = problem
        self.requests, self.changes = [], 0
        self.desk = Desk(self.hear, self.change)

    def change(self):
        self.changes += 1

    def hear(self, line):
        request = json.loads(line)
        self.requests.append(request["act"])
        if self.problem is not None:
            told = {"id": request["id"], "problem": self.problem}
            threading.Thread(target=self.tell, args=(told,)).start()

    def tell(self, told):
        self.desk.hear(json.dumps(told).encode() + b"\n")


@pytest.mark.parametrize(("problem", "wanted"), [("", (200, "done")), ("no", (400, "no"))])
def test_answer_of_the_rig_is_that_of_the_request(problem, wanted):
    rig = Rig(problem)
    assert rig.desk.post(b'{"act": "stop"}', 60.0) == wanted
    assert rig.requests == [{"act": "stop"}]


def test_rig_that_computes_answers_later():
    rig = Rig(problem=None)
    status, text = rig.desk.post(b"{}", 0.0)
    assert (status, text.partition(";")[0]) == (202, "sent")


def test_requests_that_wait_are_limited():
    rig = Rig(problem=None)
    for _ in range(WAITING_MAX):
        assert rig.desk.post(b"{}", 0.0)[0] == 202
    assert rig.desk.post(b"{}", 0.0)[0] == 503
    assert len(rig.requests) == WAITING_MAX
    rig.tell({"id": 1, "problem": ""})
    assert rig.desk.post(b"{}", 0.0)[0] == 202


@pytest.mark.parametrize("body", [b"", b"{", b"\xff", b"[" * 2_000])
def test_body_that_is_not_json_is_refused(body):
    rig = Rig()
    assert rig.desk.post(body)[0] == 400
    assert rig.requests == []


def test_desk_opens_with_the_elements_and_tells_news():
    rig = Rig()
    assert not rig.desk.is_open
    assert not rig.desk.opens(0.0)
    rig.tell({"elements": {"a": 1}})
    assert rig.desk.opens(0.0)
    assert not rig.desk.has_news(0)
    rig.tell({"state": {"b": 2}})
    assert rig.desk.has_news(0)
    assert not rig.desk.has_news(1)
    assert (rig.desk.elements(), rig.desk.state()) == ('{"a": 1}', '{"b": 2}')
    assert rig.changes == 2


def test_end_of_the_rig_answers_what_waits():
    rig = Rig(problem=None)
    rig.tell({"elements": {}})
    rig.desk._send = lambda line: threading.Thread(target=rig.desk.close).start()
    assert rig.desk.post(b"{}", 60.0) == (400, "rig: the run is over")
    assert rig.desk.post(b"{}", 60.0) == (400, "rig: the run is over")
    assert json.loads(rig.desk.state())["over"] is True


def test_request_that_the_rig_has_not_read_is_refused_at_the_end_of_the_run():
    rig = Rig(problem=None)
    over = {"state": {"over": True}}
    rig.desk._send = lambda line: threading.Thread(target=rig.tell, args=(over,)).start()
    assert rig.desk.post(b"{}", 60.0) == (400, "rig: the run is over")
