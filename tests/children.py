"""What the child that reads files is told to do in tests; a module of its own, since that child loads all of it."""

import os

import numpy as np


def echo(path, value):
    return {"path": path, "value": value, "turned": np.arange(24).reshape(2, 3, 4).T, "texts": np.array(["ä", "b\0c"])}


def arrays(path):
    return [np.empty((0, 3)), np.array(7.5), np.array([True]), np.arange(6, dtype=">i2").reshape(2, 3), np.float32(2.0)]


def crash(path):
    os.abort()


def endless(path):
    while True:
        pass


def greedy(path):
    return np.ones(2**40)


def stumbling(path):
    raise KeyError("what\nis this")


def writing(path):
    os.write(1, b"VTK says what it pleases")
    print("and Python too")
    return 1


def limits(path):
    import resource  # not on Windows

    return [resource.getrlimit(getattr(resource, f"RLIMIT_{name}"))[0] for name in ("CPU", "CORE", "AS")]
