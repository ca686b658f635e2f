"""A Windows to try the package in, as far as that can be had elsewhere: run as ``python -m windows
FOLDER``.

The package's own modules, and no others, see no POSIX: the modules, functions and signals that
Windows lacks are taken away, and `os.name` and `sys.platform` say so. For all code the system is as
strict as Windows: what is open, or mapped into the memory, can be neither replaced nor removed, and
names hold none of the characters that are not allowed there. Paths keep their slashes, text its
encoding.
"""

import builtins
import importlib
import os
import pkgutil
import subprocess
import sys
import time
import types
from pathlib import Path

NO_MODULES = {
    "fcntl",
    "resource",
    "pwd",
    "grp",
    "termios",
    "tty",
    "pty",
    "crypt",
    "syslog",
    "curses",
}
NO_NAMES = {
    "os": {
        *(
            "chown",
            "lchown",
            "fchown",
            "fchmod",
            "killpg",
            "getpgid",
            "getpgrp",
            "setpgid",
            "setsid",
            "getsid",
            "fork",
        ),
        *(
            "forkpty",
            "getuid",
            "geteuid",
            "getgid",
            "getegid",
            "getgroups",
            "setuid",
            "setgid",
            "sysconf",
            "ctermid",
        ),
        *(
            "sysconf_names",
            "getloadavg",
            "uname",
            "sched_getaffinity",
            "sched_setaffinity",
            "mkfifo",
            "mknod",
            "wait",
        ),
        *(
            "statvfs",
            "fstatvfs",
            "nice",
            "getpriority",
            "wait3",
            "wait4",
            "pread",
            "pwrite",
            "openpty",
            "set_blocking",
        ),
        *(
            "O_NONBLOCK",
            "O_CLOEXEC",
            "O_DIRECTORY",
            "O_NOFOLLOW",
            "O_SYNC",
            "WIFSIGNALED",
            "WTERMSIG",
            "EX_USAGE",
        ),
        *(
            "posix_fallocate",
            "posix_fadvise",
            "sendfile",
            "memfd_create",
            "listxattr",
            "setxattr",
            "getxattr",
            "sync",
        ),
        *("confstr", "fdatasync", "WNOHANG"),
    },
    "signal": {
        *(
            "SIGHUP",
            "SIGKILL",
            "SIGUSR1",
            "SIGUSR2",
            "SIGALRM",
            "SIGBUS",
            "SIGTRAP",
            "SIGQUIT",
            "SIGXCPU",
            "SIGPIPE",
        ),
        *(
            "SIGCHLD",
            "SIGCONT",
            "SIGSTOP",
            "alarm",
            "setitimer",
            "pthread_kill",
            "pthread_sigmask",
            "sigwait",
            "pause",
        ),
    },
    "time": {"clock_gettime", "tzset", "CLOCK_MONOTONIC"},
    "socket": {"AF_UNIX", "socketpair_unix"},
    "sys": {"getdlopenflags", "setdlopenflags"},
}
OTHERS = {"os": {"name": "nt", "linesep": "\r\n"}, "sys": {"platform": "win32"}}
BAD_CHARACTERS = set('<>:"|?*')


class _Less(types.ModuleType):
    """A module without some of its names."""

    def __getattr__(self, name):
        whole = importlib.import_module(self.__name__)
        if name in NO_NAMES[self.__name__]:
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}' on Windows")
        return OTHERS.get(self.__name__, {}).get(name, getattr(whole, name))

    def __setattr__(self, name, value):
        setattr(importlib.import_module(self.__name__), name, value)


LESS = {name: _Less(name) for name in NO_NAMES}
_import = builtins.__import__


def _imported(name, globals=None, locals=None, fromlist=(), level=0):
    if level == 0 and (globals or {}).get("__name__", "").partition(".")[0] == "tetopt":
        if name.partition(".")[0] in NO_MODULES:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        if name in LESS:
            return LESS[name]
    return _import(name, globals, locals, fromlist, level)


def _in_use():
    """The files that this process has open, or in its memory."""
    files = set()
    for handle in os.listdir("/proc/self/fd"):
        try:
            files.add(os.readlink(f"/proc/self/fd/{handle}"))
        except OSError:  # that of the list itself
            continue
    with open("/proc/self/maps", encoding="utf-8") as stream:
        return files | {line.split(None, 5)[5].rstrip("\n") for line in stream if "/" in line}


def _whole(path, folder=None):
    path = os.fspath(path)
    if folder is not None:
        path = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), path)
    return os.path.realpath(os.fsdecode(path))


def _strict(function, n_paths, is_new):
    """A function of files as Windows has it: it refuses those in use, and `is_new` names that
    are not allowed.
    """

    def strict(*paths, **options):
        folder = options.get("dir_fd", options.get("src_dir_fd"))
        used = _in_use()
        for path in paths[:n_paths]:
            whole = _whole(path, folder)
            if any(each == whole or each.startswith(whole + os.sep) for each in used):
                raise PermissionError(
                    13, "The process cannot access the file because it is in use", whole
                )
        if is_new:
            _check_name(paths[-1])
        return function(*paths, **options)

    return strict


def _check_name(path):
    name = os.path.basename(os.fsdecode(os.fspath(path)))
    if (
        set(name) & BAD_CHARACTERS
        or name.endswith((" ", "."))
        or any(ord(letter) < 32 for letter in name)
    ):
        raise OSError(22, "The filename, directory name, or volume label syntax is incorrect", name)


def _opened(function):
    def checked(path, *arguments, **options):
        if not isinstance(path, int):
            _check_name(path)
        return function(path, *arguments, **options)

    return checked


def become_windows():
    """From now on this process is such a Windows."""
    builtins.__import__ = _imported
    for name, n_paths, is_new in (
        ("replace", 2, True),
        ("rename", 2, True),
        ("unlink", 1, False),
        ("remove", 1, False),
        ("rmdir", 1, False),
    ):
        setattr(os, name, _strict(getattr(os, name), n_paths, is_new))
    os.link = _opened(os.link)
    os.mkdir = _opened(os.mkdir)
    os.open = _opened(os.open)
    builtins.open = _opened(builtins.open)


def import_all():
    """Import each module of the package; how many."""
    import tetopt

    names = [each.name for each in pkgutil.walk_packages(tetopt.__path__, "tetopt.")]
    for name in names:
        if not name.endswith("__main__"):
            importlib.import_module(name)
    return len(names)


COMMANDS = """\
phantom sphere -o a.nii.gz --voxel-mm 8 --labels l.nii.gz
mesh a.nii.gz -o a.vtu --nodes 60 --iterations 1 --json a.json --young 0:1,255:6
mesh a.nii.gz -o a.vtu --nodes 60 --iterations 1 --labels l.nii.gz --force
convert a.vtu a.vtk
convert a.vtu a.vtk --force
convert a.vtu a.inp --young 3
convert a.vtu a.feb --young 3 --load compress:1%
convert a.vtu a.xdmf
quality a.vtu --image a.nii.gz --check --json q.json
segment a.nii.gz a.vtu -o s.nii.gz
surface a.vtu --boundary -o a.stl
fem a.vtu --young 3 --load compress:1% -o f.vtu
view a.vtu --html v.html
"""


def main(folder):
    """Import everything, run the commands, end a process with a limit of time; 0 if all went
    well.
    """
    become_windows()
    os.chdir(folder)
    import_all()
    import tetopt.system.budget
    from tetopt.cli import main as run

    tetopt.system.budget.PROC_FOLDER = tetopt.system.budget.GROUP_FOLDER = Path(
        "there", "is", "no", "proc"
    )
    for line in COMMANDS.splitlines():
        code = run(line.split())
        if code != 0:
            print(f"{line}: exit code {code}", file=sys.stderr)
            return 1
    if tetopt.load_mesh("f.vtu").mesh.cells.shape[1] != 4:
        return 1
    return _ends_children() or _leaves_nothing()


def _ends_children():
    """A pipeline that takes too long is ended as on Windows, with what it started; 0 if so."""
    import numpy as np
    import psutil

    import tetopt
    from tetopt.study.child import run_in_child
    from tetopt.study.pipelines import PipelineInput

    job = PipelineInput(tetopt.Image(np.zeros((4, 4)), np.eye(3)), None, 10)
    outcome = run_in_child(importlib.import_module("windows").asleep, job, max_seconds=10.0)
    pid = int(Path("started.txt").read_text(encoding="utf-8"))
    is_ended = outcome.failure is not None and outcome.failure.startswith("out of time")
    return int(
        not is_ended or (psutil.pid_exists(pid) and psutil.Process(pid).status() != "zombie")
    )


def asleep(_job):
    """Start a process in a session of its own, and wait."""
    below = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True
    )
    Path("started.txt").write_text(str(below.pid), encoding="utf-8")
    time.sleep(60)


def _leaves_nothing():
    foreign_files = [name for name in os.listdir(".") if name.startswith(".")]
    if foreign_files:
        print(f"left behind: {foreign_files}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
