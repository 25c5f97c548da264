"""What this machine has for gridnav, and what is missing with the command that brings it."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gridnav.display.viewer import has_display
from gridnav.envs import GL_BACK_ENDS, gl_works

PACKAGES = (
    "gridnav", "mujoco", "gymnasium", "numpy", "numba", "scipy", "torch", "stable-baselines3", "safetensors",
    "rerun-sdk", "matplotlib", "pillow", "imageio-ffmpeg", "tensorboard", "pygame-ce", "tyro",
)  # fmt: skip


@dataclass(frozen=True)
class Check:
    """One line of the diagnosis."""

    name: str
    """What was looked at."""
    found: str
    """What is there."""
    is_fine: bool = True
    """Nothing has to be done."""
    advice: str = ""
    """What to do otherwise."""


def diagnose() -> list[Check]:
    """Everything gridnav builds on; takes a few seconds, since each GL back end is tried."""
    return [
        Check("Python", platform.python_version(), sys.version_info >= (3, 11), "install Python 3.11 or newer"),
        Check("system", f"{platform.system()} {platform.release()} {platform.machine()}"),
        Check("cores", f"{len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()}"),
        *(_package(name) for name in PACKAGES),
        _gpu(),
        *_graphics(),
        _display(),
    ]


def _package(name: str) -> Check:
    try:
        return Check(name, version(name))
    except PackageNotFoundError:
        return Check(name, "missing", is_fine=False, advice="run 'python3 start.py setup'")


def _gpu() -> Check:
    import torch  # takes seconds to import

    found = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none, and none is needed"
    return Check("CUDA GPU", found)


def _graphics() -> list[Check]:
    """MuJoCo's pictures need one of the back ends; Rerun's screenshots need a Vulkan driver."""
    working = {name: gl_works(name) for name in GL_BACK_ENDS}
    some = any(working.values())
    checks = [
        Check(
            f"MuJoCo pictures by {name}",
            "works" if works else "does not work",
            is_fine=some,
            advice="" if works else f"needs {GL_BACK_ENDS[name]}",
        )
        for name, works in working.items()
    ]
    drivers = [
        path for folder in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d") for path in Path(folder).glob("*.json")
    ]
    if sys.platform == "linux":
        advice = "apt-get install mesa-vulkan-drivers"
        checks.append(
            Check(
                "Vulkan driver", f"{len(drivers)} found" if drivers else "none: no Rerun viewer", bool(drivers), advice
            )
        )
    viewer = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    checks.append(Check("Rerun viewer", viewer or "missing", viewer is not None, "run 'python3 start.py setup'"))
    return checks


def _display() -> Check:
    if has_display():
        return Check("display", "present")
    return Check("display", "none: use 'gridnav view RUN --screenshot out.png', or open rollout.rrd where there is one")
