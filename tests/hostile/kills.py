"""Processes killed within the window of writing: at each step, and in the middle of each write.

``python -m hostile.kills FOLDER`` prints what each left, as JSON. It runs apart from the tests,
whose threads a fork would lose.
"""

import json
import os
import signal
import sys
from pathlib import Path

from hostile.faults import Steps, left_in
from models import sample_image, sample_model

import tetopt
from tetopt.system.files import checked_output, outputs_of_command, save_json

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


def written(path, k, force):
    """Write file number `k`, as a command does."""
    with outputs_of_command():
        checked_output(path, (Path(path).suffix,), force)
        WRITERS[path.name](path, k)


def killed(folder, name, case, at):
    """The step at which a child was killed, None if it came to its end; what is in the folder."""
    path = folder / name
    is_old = case in ("replaced", "through a link")
    if case == "through a link":
        (folder / "far").mkdir()
        path.symlink_to(folder / "far" / name)
    if is_old:
        written(path, 0, True)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:

        def stop(step):
            os.write(writer, step.encode())
            os.kill(os.getpid(), signal.SIGSTOP)

        code = 1
        try:
            with Steps(folder, at, stop).watched():
                written(path, 1, is_old)
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    _, status = os.waitpid(child, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    elif status != 0:
        raise AssertionError(f"{name}, {case}: the child ended with {status}")
    with os.fdopen(reader, "rb") as pipe:
        return pipe.read().decode() or None


def window(folder, name, case):
    """All steps of one file: each, what was left, and whether the next run comes to a whole file
    all the same.
    """
    wholes = []
    for k in (0, 1, 2):
        (folder / f"whole{k}").mkdir(parents=True)
        written(folder / f"whole{k}" / name, k, False)
        wholes.append((folder / f"whole{k}" / name).read_bytes())
    rows = []
    for at in range(1, 1000):
        place = folder / str(at)
        place.mkdir()
        step = killed(place, name, case, at)
        files = left_in(place)
        hidden = [each for each in files if Path(each).name.startswith(".")]
        seen = {Path(each).name: content for each, content in files.items() if each not in hidden}
        state = {None: "none", wholes[0]: "old", wholes[1]: "new"}.get(
            seen.pop(name, None), "damaged"
        )
        written(place / name, 2, True)
        again = (place / name).read_bytes() == wholes[2] and (
            case != "through a link" or (place / name).is_symlink()
        )
        rows.append([step, state, len(hidden), sorted(seen), again])
        if step is None:
            return rows
    raise AssertionError("no end of steps")


def main(folder):
    """Every file in every case, as JSON."""
    shown = {
        f"{name}, {case}": window(folder / name / case, name, case)
        for name in WRITERS
        for case in CASES
    }
    print(json.dumps(shown))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
