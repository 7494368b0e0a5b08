"""Virtual environments of competitors, whose packages do not live with ours."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

CACHE = Path(__file__).resolve().parents[1] / ".cache"


def peer_python(name: str, packages: Sequence[str], modules: Sequence[str], python: str = sys.executable) -> Path:
    """The interpreter of the environment `name`, which is made if the modules cannot be imported there.

    Args:
        name: Its folder.
        packages: What is installed.
        modules: What must be importable.
        python: The interpreter to make it with, or the versions that will do, if uv is there to find one.

    Raises:
        subprocess.CalledProcessError: If the packages cannot be installed.
        OSError: If no environment can be made.
    """
    folder = CACHE / name
    interpreter = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    check = [interpreter, "-c", f"import {', '.join(modules)}"]
    if interpreter.exists() and subprocess.run(check, capture_output=True).returncode == 0:
        return interpreter
    uv = shutil.which("uv")
    if uv:
        commands = [
            [uv, "venv", "--clear", "--python", python, str(folder)],
            [uv, "pip", "install", "--python", str(interpreter), *packages],
        ]
    else:
        venv.create(folder, clear=True, with_pip=True)
        commands = [[str(interpreter), "-m", "pip", "install", *packages]]
    for command in commands:
        subprocess.run(command, capture_output=True, text=True, check=True)
    return interpreter
