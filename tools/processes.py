"""Child processes that ROS programs run in: on a domain of their own, and never left behind."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

PR_SET_PDEATHSIG = 1
DOMAINS = range(1, 102)  # those whose ports stay clear of the ports that Linux gives out itself

_libc = ctypes.CDLL(None)
_claims: list[socket.socket] = []


def claim_ros_domain() -> int:
    """Return a ROS domain that no other process of this project on this machine has claimed.

    The claim is a socket with a name in the kernel: it ends with the process, however that ends.
    """
    for domain in DOMAINS:
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0hybrid_ins/ros_domain/{domain}")
        except OSError:
            claim.close()
            continue
        _claims.append(claim)
        return domain
    raise RuntimeError(f"all {len(DOMAINS)} ROS domains are taken by running tests and demos")


def isolated_ros() -> dict[str, str]:
    """Return the environment variables that keep ROS traffic on this machine and to ourselves."""
    return {
        "ROS_DOMAIN_ID": str(claim_ros_domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def program(name: str) -> str:
    """Return the path of an installed command, such as ``ins_node``, of the running Python."""
    return str(Path(sysconfig.get_path("scripts")) / name)


class Processes:
    """A ``with`` block whose child processes end with it.

    They are asked with SIGTERM, killed if they do not listen, and always reaped. Should this
    process itself be killed, the kernel sends them SIGTERM.
    """

    def __init__(self, patience: float = 10.0) -> None:
        self._patience = patience
        self._running: list[subprocess.Popen[str]] = []

    def start(
        self,
        command: Sequence[str | Path],
        output: IO[str] | int | None = None,
        environment: dict[str, str] | None = None,
    ) -> subprocess.Popen[str]:
        """Start a command; `output` takes what it prints, `environment` adds to ours."""
        process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT if output is not None else None,
            text=True,
            env=os.environ | (environment or {}),
            # Ctrl-C in a terminal reaches a whole process group; this process then decides when
            # and in which order its children end.
            start_new_session=True,
            preexec_fn=_begin_session,
        )
        self._running.append(process)
        return process

    def stop(self, process: subprocess.Popen[str]) -> int:
        """End a child in good order and return its exit status (negative: a signal's number)."""
        process.terminate()
        try:
            process.wait(self._patience)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process in self._running:
            self._running.remove(process)
        return process.returncode

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        while self._running:
            self.stop(self._running[-1])


def _begin_session() -> None:
    """Let the process that a child is end with its parent, and hear SIGHUP despite ``nohup``."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    _libc.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
