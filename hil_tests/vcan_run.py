#!/usr/bin/env python3
"""vcan_run [-t SECONDS] COMMAND...: run a command in a private network with vcan0, vcan1 and lo.

On a kernel with vcan this takes a network namespace. On any other it boots User Mode Linux (Debian: apt-get install
user-mode-linux kmod iproute2) as the caller, on the caller's own files: same paths, directory and environment, but TMPDIR
in RAM and /dev/null as standard input. Neither way needs root. Output comes as it is written, the first Ctrl-C goes to the
command, the second ends everything.

Exit status: the command's; 124 if time ran out; 125 if there is no way to a vcan here.
"""
from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

INTERFACES = ("vcan0", "vcan1")
TIMED_OUT, NO_WAY = 124, 125
TIMEOUT_S = 600.0
PACKAGES = {"linux.uml": "user-mode-linux", "modprobe": "kmod", "ip": "iproute2", "setpriv": "util-linux"}
"""What User Mode Linux needs here, and the Debian packages that have it."""

UP = f"""set -e
for i in {" ".join(INTERFACES)}; do ip link add $i type vcan; ip link set $i mtu 72 up; done
ip link set lo up
"""
NAMESPACE = ("unshare", "-nm" if os.geteuid() == 0 else "-rnm", "sh", "-c",
             UP + 'mount -t sysfs sysfs /sys || :; exec "$@"', "sh")
INIT = """#!/bin/bash
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
mkdir -p /dev/pts /dev/shm
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devpts devpts /dev/pts
mount -t tmpfs tmpfs /run; mount -t tmpfs tmpfs /dev/shm
ln -s /proc/self/fd /dev/fd; echo vcan >/proc/sys/kernel/hostname
mkdir -p /run/lock /run/kmod/lib; ln -s /usr/lib/uml/modules /run/kmod/lib/modules
modprobe -d /run/kmod -a can-raw can-bcm can-gw can-j1939 vcan vxcan slcan
stty -F /dev/ttyS0 raw -echo isig; stty -F /dev/ttyS1 raw -echo
( {up} touch {job}/up
  {env} cd {cwd}
  TMPDIR=/dev/shm exec setsid -cw sh -c 'exec "$@" </dev/null' sh {command} ) </dev/ttyS0 >/dev/ttyS0 2>/dev/ttyS1
echo $? >/proc/exitcode
sync; echo o >/proc/sysrq-trigger; sleep 9
"""
FP_REGISTERS = re.compile(rb"(?<=\x48\xc7\x45.)\x88\x0a\x00\x00(?=.{0,16}\xbf\x05\x42\x00\x00)", re.DOTALL)
"""In linux.uml: `iov.iov_len = 2696; ptrace(PTRACE_SETREGSET, pid, NT_X86_XSTATE, &iov)`."""


def present() -> bool:
    """Whether this network already has vcan0 and vcan1."""
    return set(INTERFACES) <= {name for _, name in socket.if_nameindex()}


def has_namespace() -> bool:
    """Whether this kernel makes a vcan in a network namespace of its own."""
    try:
        return subprocess.run([*NAMESPACE, "true"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def program(name: str) -> str | None:
    """Where a program is, among those of the administrator too."""
    return shutil.which(name, path=os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin")))


def missing_packages() -> list[str]:
    """Debian packages that User Mode Linux still needs on this machine."""
    return sorted(package for name, package in PACKAGES.items() if not program(name))


def way() -> str:
    """How the command gets its vcan here, in words."""
    if present():
        return "on this network"
    return "in a network namespace" if has_namespace() else "in User Mode Linux, as this kernel has no vcan"


def obstacle() -> str | None:
    """Why there is no way to a vcan on this machine and what to do, or None when there is one."""
    if present() or has_namespace():
        return None
    missing = missing_packages()
    return f"this kernel has no vcan; to run one that has: apt-get install {' '.join(missing)}" if missing else None


def kernel(job: Path) -> Path:
    """The User Mode Linux to start: a copy that also runs on processors with AMX, or the installed one.

    Linux 6.1 hands 2,696 bytes of processor state back to the host, which refuses less than its whole state (11,008 bytes
    with AMX). The copy offers 16 KiB: the host takes what it has and ignores the part of AMX, which no process in the guest
    may switch on. Later versions of Linux ask for the size.
    """
    installed = Path(program("linux.uml") or "linux.uml")
    code, found = FP_REGISTERS.subn(b"\x00\x40\x00\x00", installed.read_bytes())
    if found != 1:
        return installed
    copy = job / "linux.uml"
    copy.write_bytes(code)
    copy.chmod(0o700)
    return copy


def write_init(job: Path, command: Sequence[str]) -> Path:
    """The guest's first process: it mounts, loads the CAN modules and runs the command with the caller's environment."""
    env = dict(os.environ) if sys.stdout.isatty() else {**os.environ, "NO_COLOR": "1"}
    exports = "".join(f"export {name}={shlex.quote(value)}\n" for name, value in env.items() if name.isidentifier())
    init = job / "init"
    init.write_text(INIT.format(up=UP, job=job, cwd=shlex.quote(os.getcwd()), command=shlex.join(command), env=exports))
    init.chmod(0o700)
    return init


def boot(command: Sequence[str], timeout_s: float) -> int:
    """Run the command in User Mode Linux and give its exit status."""
    missing = missing_packages()
    if missing:
        print(f"vcan_run: this kernel has no vcan: apt-get install {' '.join(missing)}", file=sys.stderr)
        return NO_WAY
    with tempfile.TemporaryDirectory(prefix="vcan-") as name:
        job = Path(name)
        keys, press = os.pipe()
        (out, ttys0), (err, ttys1) = os.pipe(), os.pipe()
        options = ["mem=2G", "rootfstype=hostfs", "rootflags=/", "rw", "quiet", f"init={write_init(job, command)}",
                   f"uml_dir={job}", "con=null", "con0=null", f"ssl0=fd:{keys},fd:{ttys0}", f"ssl1=null,fd:{ttys1}"]
        with (job / "log").open("w") as log:
            guest = subprocess.Popen(
                [program("setpriv") or "setpriv", "--pdeathsig", "TERM", str(kernel(job)), *options],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, pass_fds=(keys, ttys0, ttys1),
                start_new_session=True, env={**os.environ, "TMPDIR": tempfile.gettempdir()})
        for fd in (keys, ttys0, ttys1):
            os.close(fd)
        pumps = [threading.Thread(target=pump, args=pair) for pair in ((out, 1), (err, 2))]
        for thread in pumps:
            thread.start()
        signal.signal(signal.SIGTERM, lambda *_: guest.terminate())
        status = wait(guest, press, timeout_s)
        for thread in pumps:
            thread.join()
        os.close(press)
        if not (job / "up").exists():
            print(f"vcan_run: User Mode Linux did not come up:\n{(job / 'log').read_text()}", file=sys.stderr)
            status = NO_WAY
        return status


def wait(guest: subprocess.Popen[bytes], press: int, timeout_s: float) -> int:
    """The guest's exit status. press: where a key pressed for the command is written."""
    end, interrupted = time.monotonic() + timeout_s, False
    while True:
        try:
            return guest.wait(end - time.monotonic())
        except KeyboardInterrupt:
            os.write(press, b"\3")
            if interrupted:
                guest.terminate()
            interrupted = True
        except subprocess.TimeoutExpired:
            guest.terminate()
            guest.wait()
            print(f"vcan_run: stopped after {timeout_s:g} s", file=sys.stderr)
            return TIMED_OUT


def pump(source: int, target: int) -> None:
    """Copy what the guest writes, until it ends or nobody reads any more."""
    with open(source, "rb", 0) as pipe, contextlib.suppress(BrokenPipeError):
        while data := pipe.read(65536):
            view = memoryview(data)
            while view:
                view = view[os.write(target, view):]


def run(command: Sequence[str], timeout_s: float = TIMEOUT_S) -> int:
    """Run the command where vcan0 and vcan1 are, and give its exit status."""
    if has_namespace():
        os.execvp("timeout", ["timeout", "--foreground", str(timeout_s), *NAMESPACE, *command])
    return boot(command, timeout_s)


def main() -> None:
    """The command line."""
    arguments, timeout_s = sys.argv[1:], TIMEOUT_S
    if arguments[:1] == ["-t"]:
        timeout_s, arguments = float(arguments[1]), arguments[2:]
    sys.exit(run(arguments, timeout_s) if arguments else __doc__)


if __name__ == "__main__":
    main()
