"""One run of Cleaver, as a program: the folder in argv[1] holds job.npz and gets mesh.npz; see `cleaver`."""

import importlib
import sys
from pathlib import Path

import numpy as np


def main(folder: Path) -> None:
    """Mesh the labels; points are in voxels of the cube, 0 to n."""
    itk = importlib.import_module("itk")
    with np.load(folder / "job.npz") as job:
        # ITK's arrays run z, y, x.
        image = itk.image_from_array(np.ascontiguousarray(job["labels"].T.astype(np.float32)))
        mesher = itk.CleaverImageToMeshFilter[type(image), itk.Mesh[itk.D, 3]].New(Input=image)
        mesher.SetFeatureScaling(float(job["feature_scaling"]))
        mesher.SetLipschitz(float(job["lipschitz"]))
    mesher.Update()
    mesh = mesher.GetOutput(0)
    points = np.asarray(itk.array_from_vector_container(mesh.GetPoints()))
    rows = np.asarray(itk.array_from_vector_container(mesh.GetCellsArray())).reshape(-1, 6)  # kind, 4, and the nodes
    np.savez(folder / "mesh.npz", points=points, cells=rows[:, 2:].astype(np.int64))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
