"""As on Windows, every module is imported, and every command answers, without POSIX's modules and functions."""

import subprocess
import sys

import pytest

from gsplat_edu.cli.main import COMMANDS

WITHOUT_POSIX = """
import importlib, os, pkgutil, signal, sys
import gsplat_edu

names = [module.name for module in pkgutil.walk_packages(gsplat_edu.__path__, "gsplat_edu.")]
names = [name for name in names if "._" not in name and name != "gsplat_edu.__main__"]
for name in names:  # and with them other packages, which look after themselves
    importlib.import_module(name)
for name in [name for name in sys.modules if name.startswith("gsplat_edu.") and name != "gsplat_edu._native"]:
    del sys.modules[name]
for name in ("fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"):
    sys.modules[name] = None
for name in "SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGSTOP SIGTSTP SIGUSR1 SIGWINCH".split():
    delattr(signal, name)
for name in "fork getpgid getuid killpg register_at_fork sched_getaffinity setsid sysconf uname".split():
    delattr(os, name)
for name in names:
    importlib.import_module(name)
from gsplat_edu.cli.main import main
for line in sys.stdin.read().splitlines():
    try:
        main(line.split())
    except SystemExit as stop:
        assert stop.code == 0, line
sys.platform = "win32"
print("studio", main(["studio", "."]), file=sys.stderr)
"""


@pytest.mark.own_process
def test_only_studio_needs_posix():
    lines = "\n".join(f"{name} --help" for name in COMMANDS)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX], input=lines, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert all(f"usage: gsplat-edu {name} " in done.stdout for name in COMMANDS)
    assert done.stderr.splitlines() == [
        "gsplat-edu studio: studio: does not run on Windows; use sfm, train and view, or run it in WSL",
        "studio 2",
    ]
