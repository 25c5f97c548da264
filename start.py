"""Set gridnav up on a machine that has only Python 3.11 or newer, and run it.

    python3 start.py COMMAND ...      any command of gridnav, such as: ladder --budget quick
    python3 start.py setup            only install, into the folder .venv beside this file
    python3 start.py test [...]       the fast tests; further arguments go to pytest
    python3 start.py check            format, lint, types, and whether the pins are current
    python3 start.py lock [...]       renew the pins, newest releases with --upgrade

The first call downloads the pinned packages (about 2 GB, 5 GB on disk); later ones start at once.
Exit codes of its own: 2 for a Python that is too old, 3 where installing failed; otherwise the command's.
"""

import sys

if sys.version_info < (3, 11):  # an older Python must be able to read this page as far as here
    print("start.py: needs Python 3.11 or newer, this is Python " + sys.version.split()[0], file=sys.stderr)
    sys.exit(2)

import hashlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
STAMP = VENV / "gridnav-setup.txt"
WINDOWS = os.name == "nt"

# Each file of pins, and what it pins. uv stands apart, because pip installs it and it installs the rest.
PINS = {
    "requirements.txt": ["pyproject.toml", "--group", "dev"],
    "requirements-uv.txt": ["--group", "setup"],
}

# Exactly the files that were pinned, and never a package that would run code while it is built.
PINNED = ("--require-hashes", "--only-binary", ":all:")

# Settings of a shell (ROS, conda, another environment) that would reach into ours.
LEAKS = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "CONDA_PREFIX"}
LEAKS |= {"PIP_USER", "PIP_TARGET", "PIP_PREFIX", "UV_SYSTEM_PYTHON", "UV_TARGET", "UV_PREFIX"}
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in LEAKS}


def main() -> int:
    """Run one verb and return its exit code."""
    verb, arguments = (sys.argv[1:2] or ["--help"])[0], sys.argv[2:]
    if verb in ("-h", "--help"):
        print(__doc__)
        return 0
    if verb == "lock":
        return lock(arguments)
    set_up()
    if verb == "setup":
        return 0
    if verb == "check":
        return check()
    if verb == "test":
        os.chdir(ROOT)
        become(tool("pytest"), "-n", str(min(4, os.cpu_count() or 1)), *arguments)
    become(tool("gridnav"), verb, *arguments)


def tool(name: str) -> str:
    """Path of a program in the environment."""
    return str(VENV / ("Scripts" if WINDOWS else "bin") / (name + (".exe" if WINDOWS else "")))


def call(*command: str) -> int:
    """Run a command in the repository and return its exit code."""
    return subprocess.call(command, cwd=ROOT, env=ENVIRONMENT)


def become(*command: str) -> NoReturn:
    """Go on as another program, which then gets Ctrl-C and gives the exit code."""
    if WINDOWS:  # exec there returns to the shell at once
        signal.signal(signal.SIGINT, lambda *_: None)
        sys.exit(subprocess.call(command, env=ENVIRONMENT))
    os.execve(command[0], command, ENVIRONMENT)


# ---------------------------------------------------------------------------------------- install


def set_up() -> None:
    """Install the pinned packages and gridnav itself, unless that is done already."""
    if is_set_up():
        return
    say("setting up .venv (once, a minute or two) ...")
    install_uv()
    say("installing the pinned packages ...")
    here = ("--python", tool("python"))
    quiet = () if sys.stderr.isatty() else ("--quiet",)  # progress bars are for people
    install(tool("uv"), "pip", "sync", *here, *quiet, *PINNED, "requirements.txt")
    gridnav = ("--no-deps", "--no-build-isolation", "--editable", ".")
    install(tool("uv"), "pip", "install", *here, "--quiet", *gridnav)
    STAMP.write_text(fingerprint())  # last, so that an interrupted setup is never taken for a whole one
    say("ready")


def is_set_up() -> bool:
    """Whether the environment is whole and belongs to these pins, this Python and this folder."""
    return STAMP.exists() and STAMP.read_text() == fingerprint() and Path(tool("python")).exists()


def fingerprint() -> str:
    """What the environment depends on; the folder too, since installed scripts name it."""
    files = [(ROOT / name).read_bytes() for name in ("pyproject.toml", *PINS)]
    digests = [hashlib.sha256(file).hexdigest() for file in files]
    return "\n".join([*digests, sys.implementation.cache_tag, sysconfig.get_platform(), str(ROOT)])


def install_uv() -> None:
    """Make a fresh environment that holds pip and uv."""
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        fail("this Python lacks venv or ensurepip; on Debian and Ubuntu: apt install python3-venv")
    install(sys.executable, "-m", "venv", "--clear", str(VENV))
    install(tool("python"), "-m", "pip", "install", "-qq", "--retries", "2", *PINNED, "-r", "requirements-uv.txt")


def install(*command: str) -> None:
    """Run one step of the installation, or stop with the reason."""
    try:
        code = call(*command)
    except OSError as error:
        fail(str(error))
    if code:
        fail("could not install; see above, check the network and the free disk space, and run this again")


# ---------------------------------------------------------------------------------------- develop


def check() -> int:
    """Run every check, so that one run shows all that is wrong."""
    results = [
        call(tool("ruff"), "format", "--check", "."),
        call(tool("ruff"), "check", "."),
        call(tool("mypy")),
        check_pins(),
    ]
    return int(any(results))


def check_pins() -> int:
    """Compare the pins with pyproject.toml; releases that are newer than a pin do not count."""
    with tempfile.TemporaryDirectory() as folder:
        for name in PINS:
            renewed = Path(shutil.copy(ROOT / name, folder))
            if compile_pins(name, renewed) != 0:
                say("could not resolve " + name)
                return 1
            if renewed.read_bytes() != (ROOT / name).read_bytes():
                say(f"{name} does not follow from pyproject.toml: run `python3 start.py lock`")
                return 1
    say("pins are current")
    return 0


def lock(arguments: list[str]) -> int:
    """Write the pins anew, keeping the versions that still fit (uv's --upgrade takes the newest)."""
    if not Path(tool("uv")).exists():
        install_uv()
    return int(any([compile_pins(name, ROOT / name, *arguments) for name in PINS]))


def compile_pins(name: str, output: Path, *arguments: str) -> int:
    """Resolve one file of pins for all systems and Pythons; versions already in `output` are preferred."""
    how = ("--universal", "--python-version", "3.11", "--generate-hashes", "--no-emit-index-url", "--quiet")
    header = ("--custom-compile-command", "python3 start.py lock")
    where = ("--output-file", str(output))
    return call(tool("uv"), "pip", "compile", *how, *header, *where, *PINS[name], *arguments)


def say(line: str) -> None:
    """Tell the user, apart from what the command itself will print."""
    print("start.py:", line, file=sys.stderr, flush=True)


def fail(reason: str) -> NoReturn:
    """Stop, because the environment could not be made."""
    say(reason)
    sys.exit(3)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)
