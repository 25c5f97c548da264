"""The Rerun viewer as a process: with a window, without one, or in a browser; only this machine can reach it."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

PATIENCE_S = 60.0
"""How long a viewer may take to start, load and paint."""


class ViewerError(RuntimeError):
    """The Rerun viewer cannot be run here; the message is one line that says what to do."""


def open_window(recording_path: str | Path) -> None:
    """Show a recording in the native viewer; returns when its window is closed.

    Raises:
        ViewerError: When there is no display, no viewer, or no graphics driver.
    """
    path = existing(recording_path)
    if not has_display():
        raise ViewerError(
            "no display here: use --screenshot out.png, --web for a browser on this machine, or --save out.rrd "
            "and open that with `rerun out.rrd` on a machine with a display"
        )
    with _running([*_command("auto"), str(path)]) as (process, log):
        if process.wait() != 0:
            raise _failure(_text(log))


def open_empty_window() -> int:
    """Open the native viewer and leave it to the user, who closes it; the port where it takes recordings.

    Raises:
        ViewerError: When there is no display, no viewer, or no graphics driver.
    """
    if not has_display():
        raise ViewerError(
            "no display here for --live: start `rerun --bind 127.0.0.1 --port 9876` where there is one and give "
            "--live-port 9876, or leave --live out"
        )
    port = free_port()
    process = subprocess.Popen(
        [*_command(str(port)), "--hide-welcome-screen"], env=_environment(), stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        wait_until(lambda: process.poll() is not None or is_open(port), "start")
    except BaseException:
        _end(process)
        raise
    if process.poll() is not None:
        raise ViewerError("the Rerun viewer ended at once: `gridnav doctor` says what is missing")
    return port


def address_of(port: int) -> str:
    """Where a viewer on this machine takes recordings.

    Raises:
        ViewerError: When nobody listens there.
    """
    if not is_open(port):
        raise ViewerError(
            f"no viewer listens on port {port} of this machine: start `rerun --bind 127.0.0.1 --port {port}`"
        )
    return f"rerun+http://127.0.0.1:{port}/proxy"


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def web_viewer(recording_path: str | Path, port: int = 0) -> Iterator[tuple[str, Callable[[], bool]]]:
    """A recording served to browsers on this machine; the server ends with the block.

    Args:
        recording_path: The .rrd file.
        port: Where the page is; a free one by default.

    Yields:
        The page's address, and whether the server still runs.

    Raises:
        ViewerError: When there is no viewer, the port is in use, or it does not start.
    """
    path = existing(recording_path)
    if port and is_open(port):
        raise ViewerError(f"port {port} is in use: name another one with --port, or leave it out for a free one")
    data_port, page_port = free_port(), port or free_port()
    command = [*_command(str(data_port)), "--serve-web", "--web-viewer-port", str(page_port), str(path)]
    with _running(command) as (process, log):
        wait_until(lambda: process.poll() is not None or (is_open(page_port) and is_open(data_port)), "serve its page")
        if process.poll() is not None:
            raise _failure(_text(log))
        # The address under which the page finds its data.
        data = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data_port}%2Fproxy"
        yield f"http://127.0.0.1:{page_port}/?url={data}", lambda: process.poll() is None


@contextmanager
def headless_viewer(window_size: tuple[int, int]) -> Iterator[str]:
    """A viewer without a window; its processes end with the block.

    Args:
        window_size: Width and height, pixels.

    Yields:
        The address at which it takes recordings and orders.

    Raises:
        ViewerError: When there is no viewer or no graphics driver.
    """
    port = free_port()
    size = "{}x{}".format(*window_size)
    command = [*_command(str(port)), "--headless", "--hide-welcome-screen", "--window-size", size]
    with _running(command) as (process, log):
        try:
            wait_until(lambda: process.poll() is not None or is_open(port), "start")
            if process.poll() is not None:
                raise _failure(_text(log))
            yield f"rerun+http://127.0.0.1:{port}/proxy"
        except ViewerError:
            raise
        except (OSError, RuntimeError) as error:
            # Without a driver the viewer answers first and ends then, and says why.
            with suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
            raise _failure(str(error) if process.poll() is None else _text(log)) from None


@contextmanager
def _running(command: list[str]) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """A process and what it writes; it ends with the block, with its children."""
    with tempfile.TemporaryFile() as log:
        # The `rerun` command starts the real viewer as its child: a session of their own ends them together.
        process = subprocess.Popen(
            command, env=_environment(), stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            yield process, log
        finally:
            _end(process)


def _command(port: str) -> list[str]:
    """The viewer of this Python environment, else the one on the path; bound to this machine, not to the network."""
    beside = Path(sys.executable).with_name("rerun.exe" if os.name == "nt" else "rerun")
    program = str(beside) if beside.exists() else shutil.which("rerun")
    if program is None:
        raise ViewerError("no `rerun` program here: install it with `pip install 'rerun-sdk>=0.41,<0.42'`")
    return [program, "--bind", "127.0.0.1", "--port", port]


def _environment() -> dict[str, str]:
    # The viewer sends no usage statistics where this says that it runs in continuous integration.
    return {**os.environ, "CI": "1"}


def _failure(log: str) -> ViewerError:
    """One line from what the viewer wrote, or from what asking it gave."""
    if "graphics adapter" in log or "render context" in log:
        return ViewerError(
            "the Rerun viewer found no Vulkan driver: install one, for example with "
            "`apt-get install mesa-vulkan-drivers`, which draws on the processor"
        )
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    telling = [line for line in lines if "panicked at" in line or line.startswith("Error")] or lines[-1:]
    return ViewerError(f"the Rerun viewer failed: {telling[0] if telling else 'it gave no reason'}")


def existing(recording_path: str | Path) -> Path:
    """The path of a recording.

    Raises:
        ViewerError: When there is none.
    """
    path = Path(recording_path)
    if not path.is_file():
        raise ViewerError(f"there is no recording {str(path)!r}")
    return path


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Wait for a viewer.

    Raises:
        ViewerError: When it takes longer than ``PATIENCE_S``.
    """
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise ViewerError(f"the Rerun viewer did not {what} within {PATIENCE_S:.0f} s")
        time.sleep(0.05)


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def is_open(port: int) -> bool:
    """Somebody listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the process and its children."""
    if os.name == "nt":
        subprocess.run(["taskkill", "/PID", str(process.pid), "/T", "/F"], capture_output=True, check=False)
    else:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _text(log: IO[bytes]) -> str:
    log.seek(0)
    return log.read().decode(errors="replace")
