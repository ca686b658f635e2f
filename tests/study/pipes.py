"""Pipelines that misbehave, for tests of `run_in_child`."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import tetopt
from tetopt.study.endings import Crashed
from tetopt.study.pipelines import Produced
from tetopt.system.child import signal_words


def crash(job):
    os.kill(os.getpid(), signal.SIGSEGV)


def sleep(job):
    """Forever, with a child of its own whose process id stands in the file named by PIPES_PID."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Path(os.environ["PIPES_PID"]).write_text(str(child.pid))
    time.sleep(600)


def crash_once(job):
    """The first time; which one it is stands in the file named by PIPES_PID."""
    path = Path(os.environ["PIPES_PID"])
    if not path.exists():
        path.write_text("once")
        crash(job)
    return fine(job)._replace(notes=[f"smoothing {job.smoothing:g}"])


def crash_and_refuse(job):
    crash_once(job)
    refuse(job)


def wrap(job):
    """A shell whose program crashed."""
    raise Crashed(
        "mine crashed "
        f"({signal_words(subprocess.run(['sh', '-c', 'kill -11 $$; true']).returncode)})"
    )


def absent(job):
    raise tetopt.InputError("thing: not installed")


def quit_early(job):
    """As a library that ends the process, content."""
    os._exit(0)


def escape(job):
    """Orphans in sessions of their own, one of which takes memory; their ids stand in the file
    named by PIPES_PID.
    """
    program = (
        "import os, sys, time\n"
        "if os.fork(): os._exit(0)\n"
        "os.setsid()\n"
        "if os.fork(): os._exit(0)\n"
        "open(sys.argv[1], 'a').write(f'{os.getpid()} ')\n"
        "time.sleep(600)"
    )
    for _ in range(2):
        subprocess.run([sys.executable, "-c", program, os.environ["PIPES_PID"]])
    time.sleep(600)


def hoard_below(job):
    """Memory of a process in a session of its own."""
    program = (
        "import time; a = bytearray(900_000_000); a[::4096] = b'x' * len(a[::4096]); "
        "time.sleep(600)"
    )
    subprocess.run([sys.executable, "-c", program], start_new_session=True)


def hoard(job):
    arrays = []
    while True:
        arrays.append(np.ones(10_000_000))
        time.sleep(0.01)


def divide(job):
    return 1 / 0


def refuse(job):
    raise tetopt.InputError("thing: expected a, got b; do c")


def leave(job):
    os._exit(3)


def fine(job):
    return Produced(
        tetopt.lattice_mesh(job.image, nodes=job.nodes), {"first": 1.5, "second": 0.25}, ["a note"]
    )
