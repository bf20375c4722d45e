"""Clusters of dask on this machine, for the tests and the benchmark of `motorhil swarm`."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

WORKERS_UMASK = 0o077
"""Files that a worker writes differ from those of the campaign by their mode."""


def free_port() -> int:
    """Return a port on which nothing listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Yield the address of a scheduler with some workers, and its process."""
    host, port = "127.0.0.1", str(free_port())
    path = os.environ.get("PYTHONPATH") or str(Path(__file__).parents[3])

    def begun(stack: ExitStack, *words: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-W", "ignore", "-m", f"distributed.cli.dask_{words[0]}"]
        process = stack.enter_context(
            subprocess.Popen(
                [*command, *words[1:], "--host", host, "--no-dashboard"],
                env={**os.environ, "PYTHONPATH": path},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                umask=WORKERS_UMASK,
            )
        )
        stack.callback(process.kill)
        return process

    with ExitStack() as stack:
        scheduler = begun(stack, "scheduler", "--port", port)
        for _ in range(workers):
            begun(stack, "worker", f"tcp://{host}:{port}", "--nthreads", "1", "--no-nanny")
        yield f"{host}:{port}", scheduler
