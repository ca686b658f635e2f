"""Meshes and models as PVTU files: a master in XML, and beside it a folder of its name with a VTU file for each piece.

NAME.pvtu lists NAME/NAME_0.vtu and so on, as VTK's parallel programs and ParaView know them. What is in them is in
`tetopt.io.vtk`, how they are cut in `tetopt.io.pieces`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.parsers import expat

from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.incoming import regular_file, text_of
from tetopt.io.apart import read_apart
from tetopt.io.pieces import MOST_PIECES, joined, model_pieces
from tetopt.io.raw import RawGrid
from tetopt.io.read_vtk import arrays_of, check_counts, checked_grid
from tetopt.io.text import plain
from tetopt.io.vtk import name_in_xml, vtk_of, vtu_bytes
from tetopt.model.model import Model

SAMPLE_STEM = "mesh"  # of pieces' names where none is known yet
NUMBER_KINDS = {"f": "Float", "i": "Int", "u": "UInt"}  # VTK's words
ADDRESS_START = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:/")


def pvtu(model: Model) -> bytes:
    """The master of a model in pieces called "mesh"; `pvtu_files` has all files."""
    return [whole for _, whole in pvtu_files(model, SAMPLE_STEM)][-1]


def pvtu_files(model: Model, stem: str) -> Iterator[tuple[str, bytes]]:
    """The name and the bytes of each piece, and, after them, of the master; names as seen from the master's folder.

    Raises
    ------
    InputError
        As `tetopt.io.pieces.model_pieces`.
    """
    names, first = [], None
    for number, piece in enumerate(model_pieces(model)):
        first = piece if first is None else first
        names.append(f"{stem}/{stem}_{number}.vtu")
        yield names[-1], vtu_bytes(vtk_of(piece))
    assert first is not None
    yield f"{stem}.pvtu", _master(first, names)


def _master(first: RawGrid, names: list[str]) -> bytes:
    """What the pieces are called, and what each of them holds, which the first tells."""
    heads = [
        f"    <{tag}>\n{''.join(map(_declared, data, data.values()))}    </{tag}>\n"
        for tag, data in (("PPointData", first.point_data), ("PCellData", first.cell_data))
    ]
    pieces = "".join(f'    <Piece Source="{name_in_xml(name)}"/>\n' for name in names)
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PUnstructuredGrid" version="0.1" byte_order="LittleEndian">\n'
        f'  <PUnstructuredGrid GhostLevel="0">\n{"".join(heads)}    <PPoints>\n'
        f"{_declared('Points', first.points)}    </PPoints>\n{pieces}  </PUnstructuredGrid>\n</VTKFile>\n"
    ).encode()


def _declared(name: str, values: NDArray) -> str:
    kind = f"{NUMBER_KINDS[values.dtype.kind]}{8 * values.dtype.itemsize}"
    columns = f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""
    return f'      <PDataArray type="{kind}" Name="{name_in_xml(name)}"{columns}/>\n'


def read_pvtu(path: Path) -> RawGrid:
    """The mesh in a PVTU file, its pieces joined, see `tetopt.io.pieces.joined`.

    Raises
    ------
    InputError
        Without the path before it: no such XML, a document type; a piece that lies elsewhere than beside the file or in
        a folder there, is listed twice, missing, or as `tetopt.io.read_vtk.read_vtk` refuses it.
    """
    sources = piece_names(path)
    places = [regular_file(path.parent / source, "piece of the mesh") for source in sources]
    for place, source in zip(places, sources, strict=True):
        try:
            check_counts(place)
        except InputError as error:
            raise InputError(f"piece {plain(source)}: {error}") from error
    size = sum(place.stat().st_size for place in places)
    pieces = []
    answers = read_apart(arrays_of_pieces, path, sources, size=size, library="VTK")
    for source, (kind, errors, arrays) in zip(sources, answers, strict=True):
        if not errors and kind == "UnstructuredGrid" and not arrays:
            continue  # a piece without cells, as a process leaves that has none
        try:
            pieces.append(checked_grid(kind, errors, arrays))
        except InputError as error:
            raise InputError(f"piece {plain(source)}: {error}") from error
    if not pieces:
        raise InputError("expected an unstructured grid with cells, found none in any of its pieces")
    return joined(pieces)


def piece_names(path: Path) -> list[str]:
    """The files of the pieces that a master lists, as seen from its folder; InputError as `read_pvtu`."""
    tags: list[tuple[str, dict[str, str]]] = []

    def refuse(*_: object) -> None:
        raise InputError("has a document type or entities, which no VTK file needs; not read")

    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, attributes: tags.append((tag, attributes))
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text_of(path, "mesh file"), True)
    except expat.ExpatError as error:
        raise InputError(f"damaged, or not a VTK mesh ({error})") from error
    kind = tags[0][1].get("type", "another") if tags[0][0] == "VTKFile" else "another"
    if kind != "PUnstructuredGrid":
        raise InputError(f"expected an unstructured grid in pieces, found {plain(kind)[:40]}; damaged?")
    sources = [attributes.get("Source", "") for tag, attributes in tags if tag == "Piece"]
    if not 0 < len(sources) <= MOST_PIECES:
        raise InputError(f"expected from 1 to {MOST_PIECES} pieces, found {len(sources)}; damaged?")
    for source in sources:
        steps = source.split("/")
        if "\\" in source or ADDRESS_START.match(source) or not {"", ".", ".."}.isdisjoint(steps):
            raise InputError(
                f'expected pieces beside the file, or in folders there, got "{plain(source)[:200]}"; not read'
            )
        if not source.lower().endswith(".vtu"):
            raise InputError(f'expected pieces named .vtu, got "{plain(source)[:200]}"')
    if len(set(sources)) < len(sources):
        raise InputError("damaged: it lists a piece twice")
    return sources


# In the child


def arrays_of_pieces(path: str, sources: list[str]) -> list[tuple[str, str, dict[str, Any]]]:
    """`tetopt.io.read_vtk.arrays_of` of each piece, by its name as seen from the master."""
    return [arrays_of(str(Path(path).parent / source)) for source in sources]
