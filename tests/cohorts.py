"""Folders of cohorts as runs leave them, made up: numbers that scatter, failures, and names that
mean harm.
"""

import io
import json

import numpy as np
import PIL.Image

from tetopt.cohort.layout import failure_path, log_path, mesh_name, numbers_path, subject_folder

HOSTILE = "</script><img src=x onerror=alert(1)>\u202e\t\n=1+1"
LABELS = {0: "background", 17: "hippocampus", 53: HOSTILE}


def key_of(k):
    return f"sub-{k + 1:04d}"


def run_of(rng, affine=None, mask_volume=None, lost=None, violated=None, absent=None):
    """What run.json holds of a run, but for what nobody reads here."""

    def scattered(value, spread):
        return value * float(np.exp(spread * rng.normal()))

    affine = np.diag([1.0, 1.0, 1.2, 1.0]) if affine is None else affine
    volume = scattered(1.43e6, 0.09) if mask_volume is None else mask_volume
    seconds = scattered(120.0, 0.2)
    n_cells = round(scattered(45000, 0.03))
    sizes = volume * np.array([0.9, 0.003, 0.003]) * np.exp(0.1 * rng.normal(size=3))
    labels = [
        {
            "label": number,
            "voxels": round(size),
            "volume": float(size),
            "dice": float(rng.normal(0.95, 0.006)),
            "n_cells": 0 if number == lost else 300,
            "is_lost": number == lost,
        }
        for number, size in zip(LABELS, sizes, strict=True)
        if number != absent
    ]
    return {
        "image": f"T1 {HOSTILE}.nii.gz",
        "image_sha256": rng.bytes(16).hex(),
        "inputs": {
            "images": [HOSTILE],
            "weights": [1.0],
            "mask": "mask.nii.gz",
            "sha256": {HOSTILE: "0"},
        },
        "box": {"shape": [180, 220, 170], "affine": np.asarray(affine).tolist()},
        "options": {"nodes": 8000, "k_D": 0.85, "volume": None, "method": "fast"},
        "request": {
            "options": {"nodes": 8000, "young": "3.0", "format": ".vtu"},
            "sha256": rng.bytes(16).hex(),
        },
        "versions": {"tetopt": "0.1.0", "numpy": "2.4.6"},
        "energies": {
            "E": 0.8,
            "E_D_fraction_of_variance": scattered(0.12, 0.08),
        },
        "quality": {
            "ndim": 3,
            "mean_rho": float(rng.normal(0.245, 0.003)),
            "min_dihedral": 12.0 + float(rng.exponential(0.05)),
            "max_dihedral": float(rng.normal(158.0, 1.0)),
            "errors": {"mean": 0.09},
            "n_under_10_degrees": 0,
        },
        "history": [{"iteration": k, "E": 1.0 / (1.0 + k)} for k in range(4)],
        "seconds": {"load": 0.1 * seconds, "optimize": 0.8 * seconds, "all": seconds},
        "memory": {
            "predicted_bytes": 1.3e9,
            "peak_bytes": round(scattered(1.1e9, 0.04)),
        },
        "violated": violated or {},
        "size": {"order": 1, "n_nodes": 8000, "n_nodes_in_all": 8000, "n_cells": n_cells},
        "mask": {
            "voxels": round(volume),
            "volume": volume,
            "dice": float(rng.normal(0.985, 0.001)),
            "components": 1,
        },
        "labels": labels,
        "interfaces": [{"label": each["label"], "area": 1000.0} for each in labels],
        "label_names": {str(number): name for number, name in LABELS.items()},
    }


def thumbnail(k):
    """A picture of 256 x 128 in a palette, of a grey of its own."""
    stream = io.BytesIO()
    PIL.Image.new("L", (256, 128), k).convert("P").save(stream, "PNG")
    return stream.getvalue()


def save_run(out, key, run, picture=None, suffix=".vtu"):
    """One subject that was meshed."""
    folder = subject_folder(out, key)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    (folder / mesh_name(key, suffix)).write_bytes(b"a mesh")
    numbers_path(out, key).write_text(json.dumps(run))
    if picture is not None:
        (folder / "figures" / "thumbnail.png").write_bytes(picture)


def save_failure(out, key, reason):
    (out / "logs").mkdir(parents=True, exist_ok=True)
    log_path(out, key).write_text("tetopt: " + reason)
    failure_path(out, key).write_text(
        json.dumps({"key": key, "reason": reason, "command": "tetopt mesh"})
    )


ODD = {  # what is wrong with each of these, of a hundred
    7: {"affine": np.diag([-1.0, -1.0, 1.2, 1.0])},
    19: {"mask_volume": 0.61e6},
    31: {"lost": 17},
    43: {
        "violated": {
            "min_dihedral": "3 of 45000 cells have a dihedral angle below 12 degrees, down to 8.10"
        }
    },
    59: {"absent": 53},
}


def save_cohort(out, n):
    """A cohort of n subjects, a twentieth of them odd and a twentieth failed; the keys that are
    expected.
    """
    rng = np.random.default_rng(n)
    out.mkdir(parents=True, exist_ok=True)
    reasons = (
        "image.nii.gz: expected a NIfTI image, got a file that ends early",
        f"ended by SIGKILL {HOSTILE}",
    )
    for k in range(n):
        if k % 100 == 82:
            continue
        if k % 20 == 2:
            save_failure(out, key_of(k), reasons[(k // 20) % 2])
        else:
            odd = ODD.get(k % 100, {})
            save_run(out, key_of(k), run_of(rng, **odd), thumbnail(k % 20))
    return [key_of(k) for k in range(n)]
