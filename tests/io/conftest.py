"""Files read in this process, where a test is not of the child that reads them."""

import pytest

from tetopt.io import frd, pictures, read_dicom, read_gmsh, read_itk, read_vtk, stacks


@pytest.fixture
def here(monkeypatch, request):
    """Sound files are read without a child, which takes a third of a second; VTK's words go where they went before.

    Files that are to be refused have their child: libraries may end the process at them.
    """
    if "assert_refused" in request.fixturenames:
        yield
        return
    from vtkmodules.vtkCommonCore import vtkOutputWindow

    for module in (frd, pictures, read_dicom, read_gmsh, read_itk, read_vtk, stacks):
        monkeypatch.setattr(module, "read_apart", lambda read, path, *rest, **_: read(str(path), *rest))
    window = vtkOutputWindow.GetInstance()
    yield
    vtkOutputWindow.SetInstance(window)
