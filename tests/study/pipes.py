"""Pipelines that misbehave, for tests of `run_in_child`."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import tetopt
from tetopt.study.pipelines import Produced


def crash(job):
    os.kill(os.getpid(), signal.SIGSEGV)


def sleep(job):
    """Forever, with a child of its own whose process id stands in the file named by PIPES_PID."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Path(os.environ["PIPES_PID"]).write_text(str(child.pid))
    time.sleep(600)


def hoard(job):
    arrays = []
    while True:
        arrays.append(np.ones(10_000_000))
        time.sleep(0.01)


def divide(job):
    return 1 / 0


def refuse(job):
    raise tetopt.InputError("thing: expected a, got b; do c")


def missing(job):
    import tetopt_has_no_such_package  # noqa: F401


def leave(job):
    os._exit(3)


def fine(job):
    return Produced(tetopt.lattice(job.image, nodes=job.nodes), {"first": 1.5, "second": 0.25}, ["a note"])
