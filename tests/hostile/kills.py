"""Processes killed within the window of writing: at each step, and in the middle of each write.

``python -m hostile.kills FOLDER`` prints what each left, as JSON. It runs apart from the tests,
whose threads a fork would lose.
"""

import json
import os
import signal
import sys
from pathlib import Path

from hostile.faults import Fault, left_in, steps_count
from models import sample_image, sample_model

import tetopt
from tetopt.system.files import check_output, outputs_of_command, save_json

MODEL, IMAGE = sample_model(3), sample_image(3)
WRITERS = {
    "a.json": lambda path, k: save_json(path, {"numbers": [k] * 1000}),
    "a.vtu": lambda path, k: tetopt.save_mesh(
        path, MODEL.mesh, {"k": [float(k)] * len(MODEL.mesh.cells)}
    ),
    "a.inp": lambda path, k: tetopt.save_model(path, MODEL._replace(about={"image": f"image {k}"})),
    "a.nii.gz": lambda path, k: tetopt.save_image(path, tetopt.Image(IMAGE.data + k, IMAGE.affine)),
}
CASES = ("new", "replaced", "through a link")


def write(path, k, force):
    """Write file number `k`, as a command does; its bytes."""
    with outputs_of_command():
        check_output(path, (path.suffix,), force)
        WRITERS[path.name](path, k)
    return path.read_bytes()


def kill_at(path, case, at):
    """The step at which a child that writes was killed, None if it came to its end."""
    if case == "through a link":
        (path.parent / "far").mkdir()
        path.symlink_to(path.parent / "far" / path.name)
    if case != "new":
        write(path, 0, True)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:

        def stop(step):
            os.write(writer, step.encode())
            os.kill(os.getpid(), signal.SIGSTOP)

        code = 1
        try:
            with steps_count(Fault(at, stop), path.parent):
                write(path, 1, case != "new")
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    _, status = os.waitpid(child, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    elif status != 0:
        raise AssertionError(f"{path.name}, {case}: the child ended with {status}")
    with os.fdopen(reader, "rb") as pipe:
        return pipe.read().decode() or None


def window(folder, name, case):
    """All steps of one file: each, what was left, and whether the next run comes to a whole file
    all the same.
    """
    wholes = []
    for k in range(3):
        (folder / f"whole{k}").mkdir(parents=True)
        wholes.append(write(folder / f"whole{k}" / name, k, False))
    states = {None: "none", wholes[0]: "old", wholes[1]: "new"}
    rows = []
    for at in range(1, 1000):
        path = folder / str(at) / name
        path.parent.mkdir()
        step = kill_at(path, case, at)
        files = {Path(each).name: content for each, content in left_in(path.parent).items()}
        state = states.get(files.pop(name, None), "damaged")
        hidden = [each for each in files if each.startswith(".")]
        others = sorted(set(files) - set(hidden))
        is_whole = write(path, 2, True) == wholes[2]
        is_whole &= path.is_symlink() == (case == "through a link")
        rows.append([step, state, len(hidden), others, is_whole])
        if step is None:
            return rows
    raise AssertionError("no end of steps")


if __name__ == "__main__":
    windows = [(f"{name}, {case}", name, case) for name in WRITERS for case in CASES]
    folder = Path(sys.argv[1])
    print(json.dumps({key: window(folder / key, name, case) for key, name, case in windows}))
