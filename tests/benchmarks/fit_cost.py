"""What runs of `tetopt mesh` take, measured, and the model of it fitted: the package's `cost.toml`.

    python tests/benchmarks/fit_cost.py -o cost.toml --rows rows.jsonl

Whole processes, one after the other, pictures and numbers written as a cohort has them; half an hour. Images are those
of nilearn's wheel and made of them; where TETOPT_DATA names a folder with the development data, real ones, too. Some
runs are left out of the fit, and its error is that of these. What is in the rows' file is not run again. Seconds are
CPU time, in units of a calibration before and after each run: other work on the machine changes both by up to a third.
Put the file into tetopt/engine/ to have predictions from it.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

import tetopt
from tetopt.engine.cost import RunSize, calibration, memory_terms, once_terms, swept_terms
from tetopt.io.images import cropped
from tetopt.io.mni import mni_path, mni_tissue
from tetopt.system.budget import BYTES_PER_GB, peak_bytes
from tetopt.system.files import checked_output, written_whole
from tetopt.system.interpreter import python_command

# Name and words of each run; those with a star are left out of the fit. {data} is the folder of development data.
# Of those that are bare no pictures are drawn.
RUNS = """
crop48_1k            {crop48} --nodes 1000
crop48_1k_bare       {crop48} --nodes 1000
half_5k_bare         {half} --nodes 5000
half_labels_5k_bare  {half} --labels {half_labels} --nodes 5000
t1_5k_bare           {t1}
half_5k              {half} --nodes 5000
half_20k             {half} --nodes 20000
half_mask_5k         {half} --mask {half_mask} --nodes 5000
half_labels_20k      {half} --labels {half_labels} --nodes 20000
half_labels_stairs   {half} --labels {half_labels} --nodes 5000 --smooth-interfaces 0
half_order2_40k      {half} --nodes 40000 --order 2
half_start           {half} --start {half_mesh}
crop96_two_5k        {crop96} {crop96_gm} --nodes 5000
crop96_labels_5k     {crop96} --labels {crop96_labels} --nodes 5000
crop96_paper_2k      {crop96} --method paper --nodes 2000
ball_10k             {ball} --nodes 10000
t1_500               {t1} --nodes 500
t1_5k                {t1}
t1_20k_0             {t1} --nodes 20000 --iterations 0
t1_20k               {t1} --nodes 20000
t1_40k_4             {t1} --nodes 40000 --iterations 4
t1_100k              {t1} --nodes 100000
t1_uniform_5k        {t1} --uniform --nodes 5000
t1_uniform_30k_4     {t1} --uniform --nodes 30000 --iterations 4
t1_paper_5k_4        {t1} --method paper --nodes 5000 --iterations 4
t1_order2_10k        {t1} --order 2 --nodes 10000
t1_gm_wm_10k         {t1} {gm} {wm} --nodes 10000
t1_labels_10k        {t1} --labels {labels} --nodes 10000
t1_mask_10k          {t1} --mask {mask} --nodes 10000
slice_500            {t1} --slice k=90 --nodes 500
slice_5k             {t1} --slice k=90 --nodes 5000
slice_labels_1k      {t1} --slice k=90 --labels {labels} --nodes 1000
parcels_8k           {parcels} --labels {parcels} --nodes 8000
thick_labels_5k      {thick} --labels {thick_labels} --nodes 5000
big_5k               {big} --nodes 5000
t1_float_5k          {t1_float}
big_60k              {big} --nodes 60000
colin_5k             {data}/brain_t1_colin27.nii.gz
flair_8k             {data}/brain_flair_oblique_aniso.nii.gz --nodes 8000
prostate_5k          {data}/prostate_t2_tra_prostatex0001.nii.gz
ct_5k                {data}/ct_abdomen_3mm.nii.gz
slab_labels_10k      {data}/ct_abdomen_slab_3mm.nii.gz --labels {data}/ct_abdomen_slab_3mm_labels.nii.gz --nodes 10000
*half_10k            {half} --nodes 10000
*crop96_labels_8k    {crop96} --labels {crop96_labels} --nodes 8000
*t1_mask_labels_20k  {t1} --labels {labels} --mask {mask} --nodes 20000
*big_float_5k        {big_float} --nodes 5000
*balls_100k_0        {balls} --nodes 100000 --iterations 0
*colin_30k           {data}/brain_t1_colin27.nii.gz --nodes 30000
*colin_order2_20k    {data}/brain_t1_colin27.nii.gz --order 2 --nodes 20000
*colin_slice_2k      {data}/brain_t1_colin27.nii.gz --slice k=80 --nodes 2000
*colin_paper_2k      {data}/brain_t1_colin27.nii.gz --method paper --nodes 2000 --iterations 10
*prostate_20k_0      {data}/prostate_t2_tra_prostatex0001.nii.gz --nodes 20000 --iterations 0
*ct_background_20k   {data}/ct_abdomen_3mm.nii.gz --background auto --nodes 20000
*slab_stairs_5k      {data}/ct_abdomen_slab_3mm.nii.gz --labels {data}/ct_abdomen_slab_3mm_labels.nii.gz --smooth-interfaces 0
*mr_slab_3k          {data}/mr_abdomen_slab_3mm.nii.gz --nodes 3000
*hippocampus_3k      {data}/hippocampus_001.nii.gz --labels {data}/hippocampus_001_label.nii.gz --nodes 3000
*lung_6k             {data}/ct_lung_small.mha --nodes 6000
*dummy_uniform_4k    {data}/prostate_dummy_mr.nii.gz --uniform --nodes 4000
*head_labels_20k     {data}/head_labels_synthseg_05.nii.gz --labels {data}/head_labels_synthseg_05.nii.gz --nodes 20000
*tissue_mask_15k     {t1} {gm} --labels {labels} --mask {mask} --nodes 15000
"""  # noqa: E501
QUICK_RUNS = "small {crop48} --nodes 200 --iterations 1\n*less {crop48} --nodes 150 --iterations 1"
PAIRED = ("half_5k", "half_20k", "crop96_paper_2k", "t1_5k", "t1_mask_10k", "t1_labels_10k", "t1_uniform_5k")
POLL_SECONDS = 0.1  # between looks at a process's threads
TRUSTED_FRACTION = 0.9  # of the runs left out, whose errors are stated as those to expect
FIT_TURNS = 20  # until weights and costs belong together: six digits come of ten
BYTES_IN_BARS = 0.5 * BYTES_PER_GB  # less memory does not decide where a run goes


class Row(NamedTuple):
    """A run that was measured."""

    name: str
    is_left_out: bool
    threads: int
    calibration_seconds: float  # at the time, see `tetopt.engine.cost.calibration`
    cpu_seconds: float
    main_seconds: float  # of these, of the main thread: the clock's, where nothing else runs
    wall_seconds: float
    peak_bytes: int
    size: RunSize


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is missing, fit, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="TOML file of the model")
    parser.add_argument("--rows", type=Path, required=True, help="file of measured runs, begun or continued")
    parser.add_argument("--quick", action="store_true", help="two small runs, to try the script itself")
    parser.add_argument("--force", action="store_true", help="replace an existing model")
    options = parser.parse_args(argv)
    try:
        output = checked_output(options.output, (".toml",), options.force)
        with tempfile.TemporaryDirectory() as folder:
            measure(options.rows, Path(folder), options.quick)
    except tetopt.InputError as error:
        print(f"fit_cost: {error}", file=sys.stderr)
        return 2
    rows = read_rows(options.rows)
    model = fitted(rows)
    with written_whole(output) as temporary:
        temporary.write_text(model_text(model, rows), encoding="utf-8")
    print(table(model, rows))
    print(f"\nthe model in {output}")
    return 0


def measure(path: Path, folder: Path, is_quick: bool) -> None:
    """Run what is not among the rows yet, and add each to the file as soon as it has ended."""
    done = {(row.name, row.threads) for row in read_rows(path)} if path.exists() else set()
    data = os.environ.get("TETOPT_DATA")
    lines = [line.split() for line in (QUICK_RUNS if is_quick else RUNS).strip().splitlines()]
    jobs = [(name, 1, words) for name, *words in lines]
    jobs += [(name, 2, words) for name, *words in lines if name in PAIRED and (os.cpu_count() or 1) > 1]
    files: dict[str, Path] = {}
    for name, threads, words in jobs:
        if (name.lstrip("*"), threads) in done or (data is None and any("{data}" in word for word in words)):
            continue
        files = files or inputs(folder, is_quick)
        row = run(name, threads, [word.format(data=data, **files) for word in words], folder / "out")
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row._asdict() | {"size": row.size._asdict()}) + "\n")
        print(f"{row.name}: {row.cpu_seconds:.1f} s, {row.peak_bytes / 1e6:.0f} MB", flush=True)


def read_rows(path: Path) -> list[Row]:
    """The runs in a file."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [Row(**(line | {"size": RunSize(**line["size"])})) for line in lines]


def inputs(folder: Path, is_quick: bool) -> dict[str, Path]:
    """The images that runs are named for, written to a folder."""
    t1, tissue, grey = tetopt.load_image(mni_path("t1")), mni_tissue(), tetopt.load_image(mni_path("gm"))
    images: dict[str, tetopt.Image] = {}
    for n in (48,) if is_quick else (48, 96):
        box = [(60, 60 + n), (60, 60 + n), (50, 50 + n)]
        for name, image in (("", t1), ("_labels", tissue), ("_gm", grey)):
            images[f"crop{n}{name}"] = cropped(image, box)
    if not is_quick:
        images |= larger_inputs(t1, tissue)
    files = {name: folder / f"{name}.nii.gz" for name in images}
    for name, image in images.items():
        tetopt.save_image(files[name], image)
    if not is_quick:
        files["half_mesh"] = folder / "half_mesh.vtu"
        tetopt.save_mesh(files["half_mesh"], tetopt.mesh_image(images["half"], 5000, iterations=4).mesh)
    return files | {contrast: mni_path(contrast) for contrast in ("t1", "gm", "wm")}


def larger_inputs(t1: tetopt.Image, tissue: tetopt.Image) -> dict[str, tetopt.Image]:
    """The T1 at half the resolution, in slices of 4 mm, in noise on 256^3 voxels; its mask; as fractions; others.

    These are parcels of places nearest to 60 points, and spheres in noise.
    """
    noise = np.random.default_rng(1)
    halved = t1.affine @ np.diag([2.0, 2.0, 2.0, 1.0])
    data = t1.data[:196, :232, :188].astype(float).reshape(98, 2, 116, 2, 94, 2).mean(axis=(1, 3, 5))
    padded = np.pad(t1.data, [(0, 256 - length) for length in t1.shape]).astype(float)
    thick = t1.affine @ np.diag([1.0, 1.0, 4.0, 1.0])
    images = {
        "half": tetopt.Image(np.rint(data), halved),
        "half_labels": tetopt.Image(tissue.data[:196:2, :232:2, :188:2], halved),
        "half_mask": tetopt.Image(1.0 * (data > 0.0), halved),
        "labels": tissue,
        "mask": tetopt.Image(1.0 * (t1.data > 0.0), t1.affine),
        "thick": tetopt.Image(t1.data[:, :, ::4], thick),
        "thick_labels": tetopt.Image(tissue.data[:, :, ::4], thick),
        "big": tetopt.Image(np.clip(np.rint(padded + noise.normal(0.0, 6.0, padded.shape)), 0.0, 255.0), t1.affine),
    }
    for name, whole in (("t1", t1), ("big", images["big"])):
        images[f"{name}_float"] = tetopt.Image((whole.data * 1.1).astype(np.float32), whole.affine)
    places = np.indices((128, 128, 128)).reshape(3, -1).T
    nearest = scipy.spatial.cKDTree(128.0 * noise.random((60, 3))).query(places)[1]
    images["parcels"] = tetopt.Image(1.0 + nearest.reshape(128, 128, 128))
    for name, shape, radius in (("ball", (160, 160, 160), 50.0), ("balls", (240, 288, 240), 80.0)):
        r = np.sqrt(sum((axis - 0.5 * n) ** 2 for axis, n in zip(np.ogrid[*map(slice, shape)], shape, strict=True)))
        images[name] = tetopt.Image(np.rint(100.0 * (r < radius) + noise.normal(0.0, 5.0, shape)))
    return images


def run(name: str, threads: int, words: list[str], base: Path) -> Row:
    """One run as a process of its own; what it took, and the sizes that it says it had."""
    base.mkdir(exist_ok=True)
    numbers = base / "run.json"
    numbers.unlink(missing_ok=True)
    command = python_command("-m", "tetopt", "mesh", *words, "-o", str(base / "mesh.vtu"), "--json", str(numbers))
    command += ["--threads", str(threads), "--force", *([] if name.endswith("_bare") else ["--figures", str(base)])]
    pace, main_seconds, peak = calibration(), 0.0, 0
    begin = time.perf_counter()
    with (base / "log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        while True:
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            # Not ru_maxrss, which begins at this process's memory; both only grow.
            peak = max(peak, peak_bytes(process.pid))
            main_seconds = max(main_seconds, thread_seconds(process.pid))
            time.sleep(POLL_SECONDS)
    process.returncode = code = os.waitstatus_to_exitcode(status)
    if not numbers.exists():  # the code is 1 if a requirement is violated, too, which costs as much
        last = (base / "log").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        raise tetopt.InputError(f"{name}: ended with code {code}: {' '.join(last)}")
    size = json.loads(numbers.read_text(encoding="utf-8"))["prediction"]["size"]
    cpu, wall = used.ru_utime + used.ru_stime, time.perf_counter() - begin
    pace = 0.5 * (pace + calibration())
    return Row(name.lstrip("*"), name.startswith("*"), threads, pace, cpu, main_seconds, wall, peak, RunSize(**size))


def thread_seconds(process: int) -> float:
    """CPU seconds of the main thread of a process so far (proc_pid_stat(5)); 0 where the system does not say."""
    try:
        text = Path(f"/proc/{process}/task/{process}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0.0
    user, system = text.rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def fitted(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The model: costs by term, the fraction that threads divide, and the errors of runs that were left out."""
    rows = at_one_pace(rows)
    single = [row for row in rows if row.threads == 1]
    known = [row for row in single if not row.is_left_out]

    def terms(size: RunSize) -> dict[str, float]:
        return once_terms(size) | swept_terms(size)

    seconds = costs(known, terms, [row.cpu_seconds for row in known])
    n_bytes = costs(known, memory_terms, [float(row.peak_bytes) for row in known])
    model = {"seconds": seconds, "bytes": n_bytes}
    left_out = [row for row in single if row.is_left_out]
    time_ratios = [summed(seconds, terms(row.size)) / row.cpu_seconds for row in left_out]
    large = [row for row in left_out if row.peak_bytes > BYTES_IN_BARS] or left_out
    space_ratios = [summed(n_bytes, memory_terms(row.size)) / row.peak_bytes for row in large]
    return model | {
        "threads": {"parallel_fraction": parallel_fraction(rows, seconds)},
        "machine": {"calibration_seconds": rows[0].calibration_seconds},
        "errors": {
            "seconds_factor": float(np.exp(np.quantile(np.abs(np.log(time_ratios)), TRUSTED_FRACTION))),
            "bytes_fraction": float(np.quantile(np.abs(np.array(space_ratios) - 1.0), TRUSTED_FRACTION)),
        },
    }


def at_one_pace(rows: Sequence[Row]) -> list[Row]:
    """The rows as if the machine had been as fast all the time as in the fastest quarter of them."""
    pace = float(np.quantile([row.calibration_seconds for row in rows], 0.25))
    return [
        row._replace(
            calibration_seconds=pace,
            cpu_seconds=row.cpu_seconds * pace / row.calibration_seconds,
            main_seconds=row.main_seconds * pace / row.calibration_seconds,
        )
        for row in rows
    ]


def costs(
    rows: Sequence[Row], terms: Callable[[RunSize], dict[str, float]], measured: Sequence[float]
) -> dict[str, float]:
    """What one of each term costs, no less than 0: the least squares of log(predicted / measured), nearly.

    A deviation is weighed by the geometric mean of both, so that twice too much counts as much as half.
    """
    names = list(terms(rows[0].size))
    table = np.array([[terms(row.size)[name] for name in names] for row in rows])
    goal = np.array(measured)
    scale = np.maximum(table.max(axis=0), 1e-300) / goal.mean()  # as nnls's tolerance is not relative
    weight = 1.0 / goal
    for _ in range(FIT_TURNS):
        solution, _ = scipy.optimize.nnls(table / scale * weight[:, None], goal * weight)
        weight = 1.0 / np.sqrt(goal * np.maximum(table / scale @ solution, 0.1 * goal))
    return dict(zip(names, (solution / scale).tolist(), strict=True))


def parallel_fraction(rows: Sequence[Row], seconds: dict[str, float]) -> float:
    """Of the sweeps' seconds, what threads divide: by what the main thread has less to do with two."""
    alone = {row.name: row for row in rows if row.threads == 1}
    pairs = [(alone[row.name], row) for row in rows if row.threads == 2 and row.name in alone and row.main_seconds]
    if not pairs:
        return 1.0
    swept = np.array([summed(seconds, swept_terms(one.size)) for one, _ in pairs])
    less = np.array([one.cpu_seconds - two.main_seconds for one, two in pairs])
    return float(np.clip(2.0 * (less @ swept) / (swept @ swept), 0.0, 1.0))


def summed(cost: dict[str, float], terms: dict[str, float]) -> float:
    """Of all terms together."""
    return sum(cost[name] * value for name, value in terms.items())


def model_text(model: dict[str, dict[str, float]], rows: Sequence[Row]) -> str:
    """The model as a TOML file, with where it comes from."""
    n_known = sum(row.threads == 1 and not row.is_left_out for row in rows)
    n_left_out = sum(row.threads == 1 and row.is_left_out for row in rows)
    lines = [
        "# What a run of `tetopt mesh` costs; terms: tetopt.engine.cost; by tests/benchmarks/fit_cost.py",
        f"# {datetime.datetime.now(datetime.UTC):%Y-%m-%d}, tetopt {tetopt.__version__}, {processor()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}",
        f"# fitted to {n_known} runs; the errors are those of {TRUSTED_FRACTION:.0%} of {n_left_out} others",
    ]
    for name, values in model.items():
        lines += ["", f"[{name}]", *(f"{key} = {value:.4g}" for key, value in values.items())]
    # A number of TOML is a float only with a point or an exponent; 0 and 1 come as they are.
    return "\n".join(re.sub(r"(= \d+)$", r"\1.0", line) for line in lines) + "\n"


def processor() -> str:
    """What the processor is called."""
    path = Path("/proc/cpuinfo")
    row = re.search(r"^model name\s*: (.*)$", path.read_text(encoding="utf-8"), re.M) if path.exists() else None
    return row.group(1) if row is not None else platform.processor() or platform.machine()


def table(model: dict[str, dict[str, float]], rows: Sequence[Row]) -> str:
    """Markdown: each run's seconds and memory, predicted and measured, those left out of the fit first."""
    lines = [
        "| run | CPU s predicted | measured | ratio | MB predicted | peak | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in sorted(at_one_pace(rows), key=lambda row: (not row.is_left_out, row.name)):
        if row.threads > 1:
            continue
        seconds = summed(model["seconds"], once_terms(row.size) | swept_terms(row.size))
        n_bytes = summed(model["bytes"], memory_terms(row.size))
        numbers = f"{seconds:.1f} | {row.cpu_seconds:.1f} | {seconds / row.cpu_seconds:.2f}"
        numbers += f" | {n_bytes / 1e6:.0f} | {row.peak_bytes / 1e6:.0f} | {n_bytes / row.peak_bytes:.2f}"
        lines.append(f"| {row.name}{'' if row.is_left_out else ' (fitted)'} | {numbers} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
