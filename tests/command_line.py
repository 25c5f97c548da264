"""The command line in this process, for tests that need no process of its own."""

import signal

import pytest

from gridnav.cli import main


def run_cli(*arguments: str) -> int:
    """Run a command; its exit code. What the command made of SIGTERM is put back."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as leaving:
            main(arguments)
    finally:
        signal.signal(signal.SIGTERM, before)
    return int(leaving.value.code or 0)
