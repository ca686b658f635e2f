"""A cohort of 200 with failures put in, its client killed on the way: everything is accounted for
(`make test-cohort`).

python benchmarks/cohort_campaign.py [SUBJECTS [SEED]]. Prints a table, and ends with 1 where a row
of it is not as it should be. Failures are put in from outside: tetopt knows nothing of them.
"""

import contextlib
import csv
import gzip
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil

import tetopt

COMMON = ("--iterations", "1", "--nodes", "60", "--threads", "1")
N_KILLS = 3  # of the client, in the first half
LEAVE_SECONDS = 60.0  # until a killed client's workers and runs have gone
FILE_BYTES = 3000  # of the largest file where a disk is full: less than a mesh, more than a log
KINDS = ("plain", "mask", "labels", "two contrasts")
# Each failure: of how many of 200 subjects, what the row says, whether a rerun mends it, nothing
# being put in any more.
FAILURES = {
    "truncated image": (2, ("failed", "image.nii.gz"), False),
    "mask beside the image": (1, ("failed", "far.nii.gz"), False),
    "labels beside the image": (1, ("failed", "far.nii.gz"), False),
    "damaged header": (1, ("failed", "image.nii"), False),
    "requirement violated": (2, ("violated", "overlap with a Dice of only"), False),
    "killed always": (1, ("failed", "its worker ended, 2 times"), True),
    "killed once": (1, ("done", ""), False),
    "disk full": (1, ("failed", "File too large"), True),
}


def image_of(rng, shift=0.0):
    """A ball of 12^3 voxels, and where it is."""
    affine = np.diag([1.0, 1.0, 1.0 + 0.2 * rng.random(), 1.0])
    affine[:3, 3] = shift
    places = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1) - 5.5
    inside = np.linalg.norm(places, axis=-1) < 4.0 + rng.random()
    return tetopt.Image(
        np.where(inside, 100.0, 10.0) + rng.random(inside.shape), affine
    ), 1.0 * inside


def saved_subject(folder, rng, kind, failure):
    """The files of a subject: its row in the table."""
    folder.mkdir()
    image, inside = image_of(rng)
    path = folder / "image.nii.gz"
    tetopt.save_image(path, image)
    row = {"image": path, "nodes": str(rng.integers(50, 70) + (100 if kind == "mask" else 0))}
    where = "mask" if kind == "mask" else "labels" if kind == "labels" else ""
    if where:
        row[where] = folder / f"{where}.nii.gz"
        tetopt.save_image(row[where], tetopt.Image(inside, image.affine))
    if kind == "two contrasts":
        row["image_2"] = folder / "second.nii.gz"
        tetopt.save_image(row["image_2"], tetopt.Image(100.0 - image.data, image.affine))
    if failure == "truncated image":
        path.write_bytes(path.read_bytes()[:-1000])
    elif failure is not None and failure.endswith("beside the image"):
        row[failure.split()[0]] = folder / "far.nii.gz"
        tetopt.save_image(
            folder / "far.nii.gz", tetopt.Image(inside, image_of(rng, 500.0)[0].affine)
        )
    elif failure == "damaged header":
        data = bytearray(gzip.decompress(path.read_bytes()))
        # NIfTI's dim[0], the number of dimensions: at most 7
        data[40:42] = (99).to_bytes(2, "little")
        row["image"] = folder / "image.nii"
        row["image"].write_bytes(data)
    elif failure == "requirement violated":
        thin = np.zeros((24, 24, 24))
        thin[4:20, 4:20, 11:13] = thin[11:13, 4:20, 4:20] = 1.0
        tetopt.save_image(path, tetopt.Image(100.0 * thin + np.arange(24.0), image.affine))
        row["mask"] = folder / "mask.nii.gz"
        tetopt.save_image(row["mask"], tetopt.Image(thin, image.affine))
    return row


def made(folder, n_subjects, rng, failures):
    """The table of the subjects, with these failures by key."""
    columns = ("subject", "image", "image_2", "mask", "labels", "nodes")
    lines = ["\t".join(columns)]
    for k in range(n_subjects):
        failure = failures.get(f"sub-{k:03d}")
        kind = "plain" if failure else KINDS[k % len(KINDS)]
        row = saved_subject(folder / f"s{k:03d}", rng, kind, failure)
        lines.append("\t".join([f"{k:03d}", *(str(row.get(name, "n/a")) for name in columns[1:])]))
    (folder / "t.tsv").write_text("\n".join(lines) + "\n")


def processes_of(out):
    """The processes that have to do with a folder of outputs, by number: their words."""
    processes = {}
    for each in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile
            words = each.cmdline()
            if each.pid != os.getpid() and any(
                str(out) in text for text in (*words, *each.environ().values())
            ):
                processes[each.pid] = words
    return processes


class Saboteur(threading.Thread):
    """Kills workers of some subjects, and leaves others no room on the disk, as long as their
    runs have a folder.
    """

    def __init__(self, out, failures):
        super().__init__(daemon=True)
        self.out, self.failures, self.seen, self.is_over = out, failures, {}, False
        self.counts = dict.fromkeys(failures, 0)

    def run(self):
        while not self.is_over:
            names = {path.name for path in (self.out / ".work").glob("sub-*.run-*")}
            for name in names - self.seen.keys():
                key, number = name.partition(".")[0], int(name.split("-")[2])
                self.seen[name] = number
                self.harm(number, key)
            for name in self.seen.keys() - names:  # the worker goes on with others
                with contextlib.suppress(ProcessLookupError):
                    number = self.seen.pop(name)
                    hard = resource.prlimit(number, resource.RLIMIT_FSIZE)[1]
                    resource.prlimit(number, resource.RLIMIT_FSIZE, (hard, hard))
            time.sleep(0.02)

    def harm(self, number, key):
        failure = self.failures.get(key)
        try:
            if failure == "killed always" or (failure == "killed once" and not self.counts[key]):
                os.kill(number, signal.SIGKILL)
            elif failure == "disk full":
                hard = resource.prlimit(number, resource.RLIMIT_FSIZE)[1]
                resource.prlimit(number, resource.RLIMIT_FSIZE, (FILE_BYTES, hard))
            else:
                return
            self.counts[key] += 1
        except ProcessLookupError:  # a client that was killed took it along
            pass


def whole(out):
    """The subjects that are there, with their files' numbers and times; what is half-written is
    an error.
    """
    there = {}
    for folder in sorted(out.glob("sub-*")):
        names = sorted(
            str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()
        )
        mesh = folder / f"{folder.name}_desc-tetopt_mesh.vtu"
        assert mesh.with_suffix(".json").is_file(), f"{folder}: only {names}"
        json.loads(mesh.with_suffix(".json").read_text())
        assert mesh.stat().st_size > 0, mesh
        assert "figures/thumbnail.png" in names, f"{folder}: only {names}"
        assert not [name for name in names if ".tmp" in name or "tetopt-" in name], names
        there[folder.name] = [
            ((folder / name).stat().st_ino, (folder / name).stat().st_mtime_ns) for name in names
        ]
    return there


def begun(folder, out, *options):
    words = [
        sys.executable,
        "-m",
        "tetopt",
        "cohort",
        str(folder / "t.tsv"),
        "-o",
        str(out),
        *COMMON,
        *options,
    ]
    with open(folder / "words.txt", "ab") as stream:
        return subprocess.Popen(words, stdout=stream, stderr=stream)


def gone_after(out):
    """Seconds until nothing runs any more that has to do with the folder."""
    begin = time.monotonic()
    while left := processes_of(out):
        assert time.monotonic() - begin < LEAVE_SECONDS, f"still there: {left}"
        time.sleep(0.05)
    return time.monotonic() - begin


def rows_of(out):
    with open(out / "cohort.tsv", newline="") as stream:
        return {row["participant_id"]: row for row in csv.DictReader(stream, delimiter="\t")}


def unlike(out, failures, expected):
    """What is not as it should be, a line each."""
    rows = rows_of(out)
    lines = [f"{key}: no row" for key in expected if key not in rows] + [
        f"{key}: unexpected" for key in rows if key not in expected
    ]
    for key, (status, words) in expected.items():
        row = rows.get(key, {})
        if row.get("status") != status or words not in row.get("reason", ""):
            lines.append(f"{key} ({failures.get(key)}): {row.get('status')}, {row.get('reason')}")
        if (status == "failed") == (out / key).exists():
            lines.append(
                f"{key}: {'a mesh, though it failed' if status == 'failed' else 'no mesh'}"
            )
        if (status == "failed") != (out / "logs" / f"{key}.failed.json").exists():
            lines.append(f"{key}: is {status}, but its record of a failure is another's")
    return lines


def same_bytes(folder, out, key):
    """Whether a subject's mesh and pictures are those of `tetopt mesh` with the words of the
    table.
    """
    with open(folder / "t.tsv", newline="") as stream:
        row = next(
            row for row in csv.DictReader(stream, delimiter="\t") if f"sub-{row['subject']}" == key
        )
    alone = folder / "alone" / key
    (alone / "figures").mkdir(parents=True)
    mesh = alone / f"{key}_desc-tetopt_mesh.vtu"
    outputs = ["-o", mesh, "--json", mesh.with_suffix(".json"), "--figures", alone / "figures"]
    images = [row[name] for name in ("image", "image_2") if row[name] != "n/a"]
    own = [
        word
        for name in ("mask", "labels")
        if row[name] != "n/a"
        for word in (f"--{name}", row[name])
    ]
    words = [
        sys.executable,
        "-m",
        "tetopt",
        "mesh",
        *images,
        *own,
        *COMMON,
        "--nodes",
        row["nodes"],
        *outputs,
    ]
    subprocess.run(list(map(str, words)), check=False, capture_output=True)
    paths = [
        path.relative_to(alone) for path in alone.rglob("*") if path.suffix in (".vtu", ".png")
    ]
    return len(paths) >= 4 and all(
        (alone / path).read_bytes() == (out / key / path).read_bytes() for path in paths
    )


def killed_on_the_way(folder, out, dice, n_subjects):
    """Begin, kill the client, begin again; what was there each time, and what was wrong with it."""
    there, wrong, seconds = {}, [], []
    for _ in range(N_KILLS):
        run = begun(folder, out)
        goal = len(there) + dice.randint(0, n_subjects // (2 * N_KILLS))
        while run.poll() is None and len(list(out.glob("sub-*"))) < goal:
            time.sleep(0.05)
        time.sleep(dice.uniform(0.0, 8.0))
        assert run.poll() is None, (folder / "words.txt").read_text()[-2000:]
        run.kill()
        run.wait()
        seconds.append(gone_after(out))
        now = whole(out)
        wrong += [f"{key}: lost or made twice" for key in there if now.get(key) != there[key]]
        there = now
        print(
            f"killed at {len(there)} subjects; nothing left of it after {seconds[-1]:.1f} s",
            flush=True,
        )
    return there, wrong


def campaign(folder, n_subjects, seed):
    """Rows of what was tried: words, result, whether it is as it should be."""
    dice, rng, out = random.Random(seed), np.random.default_rng(seed), folder / "out"
    kinds = [
        name
        for name, (count, _, _) in FAILURES.items()
        for _ in range(max(1, count * n_subjects // 200))
    ]
    numbers = dice.sample(range(n_subjects), len(kinds))
    failures = {f"sub-{k:03d}": kind for k, kind in zip(numbers, kinds, strict=True)}
    made(folder, n_subjects, rng, failures)
    expected = {
        key: FAILURES[failures[key]][1] if key in failures else ("done", "")
        for key in map("sub-{:03d}".format, range(n_subjects))
    }

    begin = time.monotonic()
    saboteur = Saboteur(out, failures)
    saboteur.start()
    there, wrong = killed_on_the_way(folder, out, dice, n_subjects)
    yield (
        f"client killed -9 {N_KILLS} times",
        f"{len(there)} meshes by then, lost or made twice {len(wrong)}",
        wrong,
    )
    code = begun(folder, out).wait()
    saboteur.is_over = True
    saboteur.join()
    now = whole(out)
    wrong = [f"{key}: lost or made twice" for key in there if now.get(key) != there[key]]
    wrong += unlike(out, failures, expected) + ([] if code == 1 else [f"exit code {code}"])
    wrong += [
        f"{key}: {kind} did not happen"
        for key, kind in failures.items()
        if kind.startswith(("killed", "disk")) and not saboteur.counts[key]
    ]
    counts = [row["status"] for row in rows_of(out).values()]
    words = ", ".join(f"{counts.count(name)} {name}" for name in sorted(set(counts)))
    yield (
        f"{len(failures)} failures in {n_subjects}",
        f"{words}; {time.monotonic() - begin:.0f} s",
        wrong,
    )

    code, before = begun(folder, out).wait(), now
    now = whole(out)
    again = {key for key in now if now[key] != before.get(key)}
    meant = {key for key, kind in failures.items() if FAILURES[kind][2]}
    wrong = [f"{key}: touched" for key in sorted(again - meant)] + [
        f"{key}: not made" for key in sorted(meant - again)
    ]
    expected |= dict.fromkeys(meant, ("done", ""))
    wrong += unlike(out, failures, expected) + ([] if code == 1 else [f"exit code {code}"])
    yield (
        "run again, nothing put in",
        f"{len(again)} made, {len(now) - len(again)} not touched",
        wrong,
    )

    some = dice.sample(sorted(now), 5)
    wrong = [f"{key}: other bytes" for key in some if not same_bytes(folder, out, key)]
    yield "bytes beside `tetopt mesh`", f"{5 - len(wrong)} of 5 alike", wrong

    rest = processes_of(folder)
    yield "processes left", str(len(rest)), [str(each) for each in rest.values()]


def main(n_subjects, seed):
    is_good = True
    with tempfile.TemporaryDirectory(prefix="campaign-") as name:
        lines = []
        print(f"{n_subjects} subjects, seed {seed}, in {name}", flush=True)
        for title, words, wrong in campaign(Path(name), n_subjects, seed):
            lines.append(f"{'as it should be' if not wrong else 'WRONG':16} {title:34} {words}")
            print(lines[-1], *wrong, sep="\n  ", flush=True)
            is_good &= not wrong
    print("", *lines, sep="\n")
    return 0 if is_good else 1


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:]]
    sys.exit(
        main(
            numbers[0] if numbers else 200,
            numbers[1] if len(numbers) > 1 else time.time_ns() % 10**6,
        )
    )
