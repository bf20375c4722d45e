"""A verb with a live page, in a process of its own."""

import re
import signal
import subprocess
import sys

from motorhil.harness.view.stream import Event
from tests.support.view.growing import Events, post
from tests.support.view.page_model import Page


class Watched:
    """A verb in a process of its own, with a page; a context manager that ends it by Ctrl-C."""

    def __init__(self, *words):
        # A new session: otherwise a shell in the background may have disabled Ctrl-C for it.
        code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
        code += "from motorhil.harness.cli.main import main; sys.exit(main(sys.argv[1:]))"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.told = []
        self.pid = self._process.pid
        found = re.search(
            r"page: (http://127.0.0.1:(\d+)/(?:\?token=)?([\w-]+)/?)", self.line("page: ")
        )
        self.address, self.port, self.token = found[1], int(found[2]), found[3]

    def line(self, begin):
        """Return the next line on stderr that begins so."""
        for line in self._process.stderr:
            self.told.append(line)
            if line.startswith(begin):
                return line
        raise AssertionError(f"ended without {begin!r}: {self.told}")

    def page(self):
        """Return the page after all events, up to the end of the record."""
        page = Page()
        with Events(self.port, token=self.token) as events:
            while (told := events.next())["event"] in ("whole", "more", "hands"):
                if told["event"] != "hands":
                    page.take(Event(told["id"], told["event"], told["data"]))
        assert told["event"] == "over"
        return page

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.communicate()

    def interrupted(self):
        """Send Ctrl-C; return the exit status and stdout."""
        self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=60)
        return self._process.returncode, out

    def act(self, **act):
        """Send a request to the rig; return the status and the text of the answer."""
        status, _, body = post(self.port, f"/hands?token={self.token}", act)
        return status, body.decode()
