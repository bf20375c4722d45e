"""Programs in separate processes that execute commands line by line."""

import os
import select
import subprocess
import sys

LONG_S = 60.0


class Program:
    """A running `python -m tests.support.programs.NAME WORDS`."""

    def __init__(self, name, *words, env=None):
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"tests.support.programs.{name}", *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=env,
        )
        self.pid = self.process.pid

    def say(self, text):
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def hear(self):
        assert select.select([self.process.stdout], [], [], LONG_S)[0], "no answer"
        return self.process.stdout.readline().strip()

    def ask(self, text):
        self.say(text)
        return self.hear()

    def signal(self, number):
        os.kill(self.pid, number)

    def kill(self):
        self.process.kill()
        self.process.wait()

    def end(self):
        """End the program, and close all its pipes."""
        self.kill()
        self.process.stdin.close()
        self.process.stdout.close()
