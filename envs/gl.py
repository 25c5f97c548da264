"""Which OpenGL back end of MuJoCo works on this machine, and a renderer that uses it."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

import mujoco

BACK_ENDS = {
    "egl": "apt-get install libegl1 libgl1",
    "osmesa": "apt-get install libosmesa6",
    "glfw": "a display",
}
"""Back ends by preference, and what each needs on Linux."""


class RenderingError(RuntimeError):
    """No GL back end works."""


@functools.cache
def works(back_end: str) -> bool:
    """Whether MuJoCo can draw with a back end.

    Tried in a process of its own: a failed attempt leaves PyOpenGL bound to the wrong library, and some drivers abort.
    """
    trial = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"
    environment = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"}
    environment["MUJOCO_GL"] = back_end
    try:
        done = subprocess.run(
            [sys.executable, "-c", trial], env=environment, capture_output=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


@functools.cache
def pick() -> str:
    """The back end to draw with: ``MUJOCO_GL`` if it is set, else the first that works.

    Raises:
        RenderingError: When none works, with the command that installs one.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    candidates = [chosen] if chosen else list(BACK_ENDS)
    if sys.platform != "linux" and not chosen:
        candidates = ["glfw"]
    for back_end in candidates:
        if works(back_end):
            return back_end
    tried = ", ".join(candidates)
    raise RenderingError(
        f"no OpenGL back end works here (tried {tried}), so MuJoCo cannot draw: install one, on Debian or Ubuntu with "
        f"'{BACK_ENDS['egl']}', or unset MUJOCO_GL if it names another"
    )


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """A renderer on a back end that works, whatever ``mujoco`` chose when it was imported.

    Raises:
        RenderingError: When none works.
    """
    back_end = pick()
    os.environ["MUJOCO_GL"] = back_end
    from mujoco.rendering.classic import gl_context

    # mujoco binds its context class at import, before anyone could ask; bind it again.
    if back_end == "egl":
        from mujoco.egl import GLContext
    elif back_end == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        GLContext = gl_context.GLContext
    gl_context.GLContext = GLContext
    renderer = mujoco.Renderer(model, height, width)
    # Shadows and mirror images take three quarters of the time on a software renderer.
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
    return renderer
