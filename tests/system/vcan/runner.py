"""Runs a command with real SocketCAN interfaces, on most Linux machines.

    python -m tests.system.vcan.runner [-n 2] -- COMMAND...

There are two ways, tried in this order: `native`, a network namespace of this kernel if it has
vcan; `uml`, a User Mode Linux kernel (Debian's package user-mode-linux, unpacked into a cache,
never installed). The latter runs as an ordinary process on this machine's files, without root and
without KVM. The exit status is the command's; 125 if neither way works, and a line on stderr gives
the reason.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from motorhil.harness.sharing_tests.arena import die_with

BOOT_S = 60  # it takes 2 to 10 s
NO_WAY = 125
CAN_MODULES = ("net/can/can", "net/can/can-raw", "net/can/can-bcm", "drivers/net/can/dev/can-dev")
VCAN_MODULE = "drivers/net/can/vcan"
NAMESPACES = (["unshare"], ["unshare", "--map-root-user"])
PROCESSES = ("--pid", "--fork", "--kill-child")  # a guest has several, which end together


class NoWayError(Exception):
    """This machine cannot provide vcan; the message gives the reason."""


def interfaces_up(ip: str, count: int) -> str:
    """Return the shell lines that bring lo and vcan0.. up."""
    lines = [f"{ip} link set up dev lo"]
    for number in range(count):
        lines.append(f"{ip} link add dev vcan{number} type vcan")
        lines.append(f"{ip} link set up dev vcan{number}")
    return " && ".join(lines)


def namespace_prefix(options: Sequence[str], probe: Sequence[str]) -> list[str] | None:
    """Return the command prefix of a namespace in which the probe succeeds, or None."""
    if shutil.which("unshare") is None or shutil.which(probe[0]) is None:
        return None
    for way in NAMESPACES:
        prefix = [*way, *options]
        if subprocess.run([*prefix, *probe], capture_output=True, check=False).returncode == 0:
            return prefix
    return None


def native_prefix() -> list[str] | None:
    """Return the command prefix of a network namespace with vcan, if this kernel has it."""
    return namespace_prefix(["--net"], ["ip", "link", "add", "dev", "vcan0", "type", "vcan"])


def cache_folder() -> Path:
    """Return the cache of unpacked packages between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "motorhil-vcan"


def unpacked(package: str) -> Path:
    """Return the folder with the Debian package's files; fetch them once."""
    folder = cache_folder() / package
    if folder.is_dir():
        return folder
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise NoWayError(f"no {tool} to fetch Debian's {package} with")
    cache_folder().mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_folder()) as scratch:
        command = ["apt-get", "-q", "-o", "APT::Sandbox::User=root", "download", package]
        fetched = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
        if fetched.returncode != 0 and os.geteuid() == 0:
            subprocess.run(["apt-get", "-q", "update"], capture_output=True, check=False)
            fetched = subprocess.run(
                command, cwd=scratch, capture_output=True, text=True, check=False
            )
        archives = list(Path(scratch).glob("*.deb"))
        if fetched.returncode != 0 or not archives:
            reason = (fetched.stderr.strip().splitlines() or ["no archive came"])[-1]
            raise NoWayError(f"apt-get download {package} failed: {reason} (try 'apt-get update')")
        root = Path(scratch) / "root"
        subprocess.run(["dpkg-deb", "-x", str(archives[0]), str(root)], check=True)
        try:
            root.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another run was faster
                raise
    return folder


def guest_script(run: Path, busybox: Path, modules: list[Path], count: int) -> str:
    """Return the guest's PID 1 script: mount, load CAN, bring interfaces up, run, power off."""
    quoted = shlex.quote(str(run))
    load = "\n".join(f"$bb insmod {shlex.quote(str(m))}" for m in modules)
    return f"""#!/bin/bash
run={quoted}; bb={shlex.quote(str(busybox))}
: >"$run/booted"
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb grep -q ' /dev devtmpfs ' /proc/mounts || $bb mount -t devtmpfs dev /dev
$bb mkdir -p /dev/pts /dev/shm
$bb mount -t devpts devpts /dev/pts
$bb mount -t tmpfs -o mode=1777 tmpfs /dev/shm
$bb mount -t tmpfs -o mode=755 tmpfs /run
for pair in fd:/proc/self/fd stdin:/proc/self/fd/0 stdout:/proc/self/fd/1 stderr:/proc/self/fd/2; do
    [ -e "/dev/${{pair%%:*}}" ] || $bb ln -s "${{pair#*:}}" "/dev/${{pair%%:*}}"
done
{load}
status={NO_WAY}
if {interfaces_up("$bb ip", count)}; then
    . "$run/environment"
    cd "$(cat "$run/folder")" && "$run/command" </dev/null >"$run/out" 2>"$run/err"
    status=$?
fi
echo $status >"$run/status"
$bb sync
$bb poweroff -f
while :; do $bb sleep 1; done
"""


def never_booted() -> Path:
    """Return the file that tells that a guest has not booted since this machine has."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return cache_folder() / f"never-booted-{boot}"


def end_of(guest: "subprocess.Popen[bytes]", booted: Path) -> None:
    """Wait for the end of a guest.

    Raises:
        NoWayError: it has not booted in time, as on some processors; it is ended.
    """
    try:
        guest.wait(BOOT_S)
    except subprocess.TimeoutExpired:
        if not booted.is_file():
            never_booted().touch()
            raise NoWayError(
                f"the User Mode Linux guest has not booted within {BOOT_S} s"
            ) from None
        guest.wait()
    finally:
        guest.kill()
        guest.wait()


def run_in_guest(command: list[str], count: int, memory_mib: int) -> int:
    """Return the command's exit status from a User Mode Linux guest on this machine's files."""
    if never_booted().is_file():
        raise NoWayError(
            f"no User Mode Linux guest has booted since this machine has ({never_booted()})"
        )
    uml = unpacked("user-mode-linux")
    busybox = unpacked("busybox-static") / "bin" / "busybox"
    kernel = uml / "usr" / "bin" / "linux.uml"
    releases = sorted((uml / "usr" / "lib" / "uml" / "modules").glob("*"))
    if not kernel.is_file() or not releases:
        raise NoWayError(f"the package in {uml} holds no linux.uml with modules")
    tree = releases[-1] / "kernel"
    modules = [path for m in (*CAN_MODULES, VCAN_MODULE) if (path := tree / f"{m}.ko").is_file()]
    with tempfile.TemporaryDirectory(prefix="motorhil-vcan-", dir="/tmp") as folder:
        run = Path(folder)
        exports = [
            f"export {k}={shlex.quote(v)}" for k, v in os.environ.items() if k.isidentifier()
        ]
        (run / "environment").write_text("\n".join(exports) + "\n")
        (run / "folder").write_text(os.getcwd())
        (run / "command").write_text("#!/bin/bash\nexec " + shlex.join(command) + "\n")
        (run / "init").write_text(guest_script(run, busybox, modules, count))
        for name in ("command", "init"):
            (run / name).chmod(0o755)
        guest = subprocess.Popen(
            [
                *(namespace_prefix(PROCESSES, ["true"]) or ()),
                str(kernel),
                f"mem={memory_mib}M",
                "root=/dev/root",
                "rootfstype=hostfs",
                "rootflags=/",
                "rw",
                f"init={run / 'init'}",
                f"uml_dir={run}",
                "umid=guest",
                "con=null",
                "con0=null,null",
                "ssl=null",
                "quiet",
                "seccomp=auto",
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "TMPDIR": "/dev/shm" if os.access("/dev/shm", os.W_OK) else "/tmp"},
            preexec_fn=partial(die_with, os.getpid()),
        )
        end_of(guest, run / "booted")
        for name, stream in (("out", sys.stdout), ("err", sys.stderr)):
            if (run / name).is_file():
                stream.write((run / name).read_text(errors="replace"))
                stream.flush()
        if not (run / "status").is_file():
            raise NoWayError(
                "the User Mode Linux guest ended without a word (is ptrace allowed here?)"
            )
        return int((run / "status").read_text())


def run(command: list[str], count: int = 2, memory_mib: int = 1024) -> int:
    """Return the command's exit status, run where vcan0 .. vcan(count-1) are up.

    Raises:
        NoWayError: this machine has no vcan and cannot get one; gives the reason.
    """
    prefix = native_prefix()
    if prefix is not None:
        script = interfaces_up("ip", count) + ' && exec "$@"'
        return subprocess.run(
            [*prefix, "bash", "-c", script, "vcan", *command], check=False
        ).returncode
    return run_in_guest(command, count, memory_mib)


def main() -> int:
    """Run the command; return its exit status, or 125."""
    parser = argparse.ArgumentParser(prog="python -m tests.system.vcan.runner", description=__doc__)
    parser.add_argument("-n", type=int, default=2, metavar="N", help="interfaces (default 2)")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    command = arguments.command[1:] if arguments.command[:1] == ["--"] else arguments.command
    if not command:
        parser.error("no command")
    try:
        return run(command, arguments.n)
    except NoWayError as reason:
        print(f"no vcan here: {reason}", file=sys.stderr)
        return NO_WAY


if __name__ == "__main__":
    sys.exit(main())
