"""A network of one's own, in which two addresses of the loop-back interface can carry two fake cameras.

Linux only. The process is started again in a fresh network namespace by `unshare` (util-linux), without privileges
where the system allows that; nothing outside is touched, and nothing of it can be reached from outside.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Mapping, Sequence

ADDRESSES = ("127.0.0.1", "127.0.0.2")
MARK = "RAINSTEREO_OWN_NETWORK"
_SIOCSIFFLAGS, _SIOCSIFADDR, _SIOCSIFNETMASK = 0x8914, 0x8916, 0x891C


def inside() -> bool:
    """Whether this process runs in a network that `run_inside` made."""
    return os.environ.get(MARK) == "1"


def run_inside(command: Sequence[str], environment: Mapping[str, str] | None = None) -> int:
    """Run a command in a network of its own; its exit status. RuntimeError where the system forbids it."""
    return subprocess.run(
        [*_unshare(), *command], env={**os.environ, **(environment or {}), MARK: "1"}, check=False
    ).returncode


def wrap(command: Sequence[str]) -> list[str]:
    """The command line that runs a command in a network of its own."""
    return [*_unshare(), *command]


def available() -> str:
    """ "" where such networks can be made; else why not."""
    try:
        words = _unshare()
    except RuntimeError as error:
        return str(error)
    done = subprocess.run([*words, "true"], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"the system allows no network namespace ({done.stderr.strip()})"


def set_up() -> None:
    """Bring the loop-back interface up with both addresses. Only call it in a network of one's own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        for interface, address in zip(("lo", "lo:1"), ADDRESSES, strict=True):
            if interface != "lo":
                for request, number in ((_SIOCSIFADDR, address), (_SIOCSIFNETMASK, "255.0.0.0")):
                    place = struct.pack("16sH2s4s8x", interface.encode(), socket.AF_INET, b"", socket.inet_aton(number))
                    fcntl.ioctl(control, request, place)
            up = struct.pack("16sH14x", interface.encode(), 0x1 | 0x40)  # IFF_UP, IFF_RUNNING
            fcntl.ioctl(control, _SIOCSIFFLAGS, up)


def _unshare() -> list[str]:
    program = shutil.which("unshare")
    if program is None:
        raise RuntimeError("two fake cameras need a network namespace: install util-linux (unshare), on Linux")
    return [program, "--net"] if os.geteuid() == 0 else [program, "--map-root-user", "--net"]
