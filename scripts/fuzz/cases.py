"""One hostile input by its number: a command line, the files that it names, and what it may
leave behind.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import NamedTuple

import nibabel
import numpy as np
from fuzz import mutations as m
from fuzz.mutations import HOSTILE_NAMES, HOSTILE_NUMBERS, one_of
from fuzz.seeds import VOXELS, Seeds, affine

QUICK = ("--nodes", "50", "--iterations", "1")
MESH_OUTPUTS = (
    ".vtu",
    ".vtk",
    ".xdmf",
    ".msh",
    ".msh2",
    ".inp",
    ".feb",
    ".mfem",
    ".mesh",
)
# What a second mutation meets in a file whose format the first has damaged.
LOST_FORMAT = (
    ValueError,
    OSError,
    EOFError,
    zlib.error,
    nibabel.wrapstruct.WrapStructError,
    nibabel.spatialimages.HeaderDataError,
    nibabel.filebasedimages.ImageFileError,
)
SPECIAL_KINDS = ("fifo", "zero", "loop", "folder", "stdin", "gone")


class Case(NamedTuple):
    """What is run in a folder of its own."""

    kind: str  # a row of the table
    what: str  # was done, in words
    words: tuple[str, ...]  # of the command
    files: dict[str, bytes]  # by path from the folder; b"special:..." is no regular file
    outputs: tuple[str, ...]  # what the command may write
    is_forbidden: bool = False  # whether it must be refused


class Draw:
    """The random choices of one case, and the files that it has collected."""

    def __init__(self, seeds: Seeds, seed: int, number: int) -> None:
        self.rng = np.random.default_rng([seed, number])
        self.seeds = seeds
        self.files: dict[str, bytes] = {}

    def one(self, *values):
        """One of some values."""
        return one_of(self.rng, values)

    def good(self, name, as_name=None):
        """A valid file, as it is."""
        as_name = as_name or name
        self.files[as_name] = self.seeds.files[name]
        if name in ("i.nhdr", "i.mhd"):
            self.files["i.raw"] = self.seeds.files["i.raw"]
        return as_name

    def bad(self, name, mutations):
        """A valid file mutated, once or sometimes twice; its name, and the words."""
        self.good(name)
        words = []
        for _ in range(1 if self.rng.random() < 0.85 else 2):
            mutation = one_of(self.rng, mutations)
            try:
                word, self.files[name] = mutation(self.rng, self.files[name])
            except LOST_FORMAT:  # the first has left nothing of the format
                break
            words.append(word)
        return name, "; ".join(words)


# What is done with an image, and with a mesh


def with_image(
    draw: Draw, image: str, *, is_main: bool = False
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A command that reads this image, and what it writes."""
    how = (
        "mesh"
        if is_main
        else draw.one(
            *["mesh"] * 4,
            "mask",
            "labels",
            "sizing",
            "second",
            "uniform",
            "quality",
            "quality mask",
            "segment",
            "fem",
            "view",
            "convert",
            "paper",
            "error",
        )
    )
    out = f"out{draw.one('.vtu', '.vtu', *MESH_OUTPUTS[:4])}"
    if how in ("mesh", "uniform", "paper", "error"):
        more = {
            "uniform": ("--uniform",),
            "paper": ("--method", "paper"),
            "error": ("--target-error", "0.5"),
        }.get(how, ())
        quick = QUICK[2:] if how == "error" else QUICK
        return ("mesh", image, "-o", out, *quick, *more, "--json", "out.json"), (out, "out.json")
    good = draw.good("f.nii")
    if how in ("mask", "labels", "sizing"):
        return ("mesh", good, f"--{how}", image, "-o", out, *QUICK), (out,)
    if how == "second":
        return ("mesh", good, image, "-o", out, *QUICK), (out,)
    mesh = draw.good("m.vtu")
    return {
        "quality": (
            ("quality", mesh, "--image", image, "--json", "q.json", "--check"),
            ("q.json",),
        ),
        "quality mask": (
            ("quality", mesh, "--image", good, draw.one("--mask", "--labels"), image),
            (),
        ),
        "segment": (("segment", image, mesh, "-o", "seg.nii.gz"), ("seg.nii.gz",)),
        "fem": (("fem", image, mesh, "-o", "u.vtu"), ("u.vtu",)),
        "view": (("view", mesh, "--image", image, "--html", "v.html"), ("v.html",)),
        "convert": (
            ("convert", mesh, "c.feb", "--image", image, "--young", "1+abs(h)"),
            ("c.feb",),
        ),
    }[how]


def with_mesh(draw: Draw, mesh: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A command that reads this mesh, and what it writes."""
    how = draw.one(
        "quality",
        "quality image",
        *["convert"] * 4,
        "convert young",
        "surface",
        "surface label",
        "interfaces",
        "segment",
        "fem",
        "fem image",
        "fem loads",
        "view",
        "view",
        "start",
    )
    out = f"out{draw.one(*MESH_OUTPUTS)}"
    surface = f"s{draw.one('.stl', '.ply', '.vtp', '.vtk')}"
    image = draw.good("i.nii") if how in ("quality image", "segment", "fem image", "start") else ""
    loads = (
        "--load",
        "hold:superior",
        "--load",
        "gravity:0,0,-9810",
        "--young",
        "3",
        "--density",
        "1000",
    )
    return {
        "quality": (("quality", mesh, "--check", "--json", "q.json"), ("q.json",)),
        "quality image": (("quality", mesh, "--image", image), ()),
        "convert": (("convert", mesh, out), (out,)),
        "convert young": (
            ("convert", mesh, out, "--young", "3", "--set", "p=point:5,15,20:9", "--space", "lps"),
            (out,),
        ),
        "surface": (("surface", mesh, "-o", surface, "--boundary"), (surface,)),
        "surface label": (("surface", mesh, "-o", surface, "--label", "1"), (surface,)),
        "interfaces": (("surface", mesh, "-o", "s.ply", "--interfaces", "--boundary"), ("s.ply",)),
        "segment": (("segment", image, mesh, "-o", "seg.nii"), ("seg.nii",)),
        "fem": (("fem", mesh, "-o", "u.vtu", "--json", "u.json"), ("u.vtu", "u.json")),
        "fem image": (("fem", image, mesh), ()),
        "fem loads": (("fem", mesh, *loads), ()),
        "view": (("view", mesh, "--html", "v.html"), ("v.html",)),
        "start": (("mesh", image, "--start", mesh, "-o", out, "--iterations", "1"), (out,)),
    }[how]


# The rows of the table


def nifti(draw):
    """NIfTI-1, NIfTI-2, packed or not."""
    name = draw.one(
        "i.nii",
        "i.nii",
        "f.nii",
        "i2.nii",
        "i4.nii",
        "labels.nii",
        "mask.nii",
        "sizes.nii",
        "i.nii.gz",
    )
    of_header = m.unpacked(m.nifti) if name.endswith(".gz") else m.nifti
    more = (
        (m.affines, m.voxels, m.shapes, of_header) if name in ("i.nii", "f.nii") else (of_header,)
    )
    image, what = draw.bad(name, (of_header, of_header, of_header, *more, *m.ANY))
    if name == "i.nii" and draw.rng.random() < 0.15:
        word, packed = m.packed_worse(draw.rng, draw.files.pop(image))
        image, what = "i.nii.gz", f"{what}; {word}"
        draw.files[image] = packed
    role = {"labels.nii": "--labels", "mask.nii": "--mask", "sizes.nii": "--sizing"}.get(name)
    if role and draw.rng.random() < 0.8:
        words = ("mesh", draw.good("f.nii"), role, image, "-o", "out.vtu", *QUICK), ("out.vtu",)
    else:
        words = with_image(draw, image)
    return what, *words


def odd_images(draw):
    """Well-formed images of odd grids and intensities, with masks and labels that touch the box."""
    rng, place, size = draw.rng, affine(), VOXELS
    image = nibabel.Nifti1Image.from_bytes(draw.seeds.files["f.nii"])
    index = np.indices((size,) * 3)
    what = draw.one("sheared", "sheared", "affine", "affine", "voxels", "voxels", "shape")
    if what == "sheared":
        place[:3, :3] = place[:3, :3] @ (np.eye(3) + np.triu(rng.uniform(-2.0, 2.0, (3, 3)), 1))
        name, data = (
            "sheared",
            nibabel.Nifti1Image(image.get_fdata().astype(np.float32), place).to_bytes(),
        )
    else:
        mutation = {"affine": m.affines, "voxels": m.voxels, "shape": m.shapes}[what]
        name, data = mutation(rng, draw.seeds.files["f.nii"])
    draw.files["odd.nii"] = data
    more = draw.one(
        (),
        ("--mask", "beside.nii"),
        ("--labels", "beside.nii"),
        ("--background", "auto"),
        ("--uniform",),
    )
    if "beside.nii" in more:
        normal, ball = rng.normal(size=3), rng.uniform(0, size, 3)
        side = np.tensordot(normal, index - size / 2, 1) > rng.uniform(-6, 6)
        inside = ((index - ball[:, None, None, None]) ** 2).sum(axis=0) < rng.uniform(4, 80)
        values = {0: side, 1: inside, 2: side & ~inside, 3: side * 1 + inside * 2}[
            int(rng.integers(4))
        ]
        values = values > 0 if more[0] == "--mask" else values
        other = bytearray(
            nibabel.Nifti1Image(np.asarray(values).astype(np.uint8), place).to_bytes()
        )
        other[76:108], other[252:328] = data[76:108], data[252:328]  # NIfTI's place, whatever it is
        draw.files["beside.nii"] = bytes(other)
    return (
        f"{name} {' '.join(more)}",
        ("mesh", "odd.nii", "-o", "out.vtu", *more, *QUICK),
        ("out.vtu",),
    )


def mgh(draw):
    """FreeSurfer's MGH and MGZ."""
    name = draw.one("i.mgh", "i.mgz")
    header = m.mgh if name == "i.mgh" else m.unpacked(m.mgh)
    image, what = draw.bad(name, (header, header, header, *m.ANY))
    return what, *with_image(draw, image)


def itk(draw):
    """NRRD and MetaImage, with their data or beside it."""
    name = draw.one("i.nrrd", "i.nhdr", "i.mha", "i.mhd", "z.mha", "z.nrrd")
    image, what = draw.bad(name, (m.key_values, m.key_values, m.key_values, m.key_values, *m.ANY))
    return what, *with_image(draw, image)


def outside(draw):
    """Headers whose data lie outside of the folder, and XML that would be expanded: to be
    refused.
    """
    if draw.rng.random() < 0.6:
        name = draw.one("i.mhd", "i.nhdr")
        _, what = draw.bad(name, (m.outside,))
        draw.files[name] = m.outside(draw.rng, draw.seeds.files[name])[1]
        what = f"data outside: {draw.files[name][-60:]!r}"
        draw.files.pop("i.raw")
        return what, *with_image(draw, name, is_main=True)
    name = draw.one("ascii.vtu", "m.vtu", "inline.vtu")
    draw.good(name)
    what, draw.files[name] = m.xml_bomb(draw.rng, draw.files[name])
    return what, *with_mesh(draw, name)


def dicom(draw):
    """A folder of DICOM slices."""
    names = [f"d/{draw.good(f's{k}.dcm', f'd/s{k}.dcm')[2:]}" for k in range(4)]
    how = draw.one(
        "mutate", "mutate", "mutate all", "drop", "double", "rubbish", "one file", "series"
    )
    name = draw.one(*names)
    what = how
    if how in ("mutate", "one file"):
        what, draw.files[name] = one_of(draw.rng, (m.dicom, m.dicom, m.dicom, *m.ANY))(
            draw.rng, draw.files[name]
        )
    elif how == "mutate all":
        state = draw.rng.bit_generator.state
        for each in names:
            draw.rng.bit_generator.state = state
            what, draw.files[each] = m.dicom(draw.rng, draw.files[each])
    elif how == "drop":
        del draw.files[name]
    elif how == "double":
        draw.files["d/again.dcm"] = draw.files[name]
    elif how == "rubbish":
        what, draw.files["d/rubbish"] = m.replaced(draw.rng, draw.files[name])
    elif how == "series":
        draw.files[name] = draw.files[name].replace(b"1.2.3.4", b"9.9.9.9", 1)
    if how == "one file":
        draw.files = {"s.dcm": draw.files[name]}
        return what, *with_image(draw, "s.dcm", is_main=True)
    return f"folder: {what}", *with_image(draw, "d", is_main=draw.rng.random() < 0.7)


def zarr_volumes(draw):
    """Arrays of Zarr, one of whose chunks, or its metadata, is damaged, gone or of another
    array.
    """
    files = draw.seeds.files
    folder = draw.one(*sorted({name.partition("/")[0] for name in files if ".zarr/" in name}))
    names = [draw.good(name) for name in files if name.startswith(f"{folder}/")]
    texts = [
        name
        for name in names
        if name.endswith((".json", ".zarray", ".zattrs", ".zgroup", ".zmetadata"))
    ]
    chunks = [name for name in names if name not in texts]
    how = draw.one("chunk", "chunk", "chunk", "text", "text", "gone", "another", "special")
    if how == "chunk":
        name, what = draw.bad(
            draw.one(*chunks), (m.packed_head, m.packed_head, m.packed_head, *m.ANY)
        )
    elif how == "text":
        name, what = draw.bad(draw.one(*texts), (*m.TEXT, *m.TEXT, *m.ANY))
    else:
        name, what = draw.one(*(names if how == "gone" else chunks)), how
        others = [
            other
            for other in files
            if ".zarr/" in other and other.rsplit("/", 1)[1].strip("0.1") == ""
        ]
        draw.files[name] = (
            b"special:" + draw.one(*SPECIAL_KINDS).encode()
            if how == "special"
            else files[draw.one(*others)]
        )
        if how == "gone":
            del draw.files[name]
    return f"{name}: {what}", *with_image(draw, folder, is_main=draw.rng.random() < 0.7)


def pictures(draw):
    """PNG, TIFF, BMP, JPEG."""
    image, what = draw.bad(
        draw.one("p.png", "p.tif", "p.bmp", "p.jpg"), (m.damaged_picture, m.damaged_picture, *m.ANY)
    )
    return what, *with_image(draw, image, is_main=True)


def vtu(draw):
    """VTK's XML: text, packed, appended."""
    name = draw.one(
        "m.vtu",
        "m.vtu",
        "solved.vtu",
        "q.vtu",
        "flat.vtu",
        "ascii.vtu",
        "ascii.vtu",
        "inline.vtu",
        "zlib.vtu",
        "appended.vtu",
    )
    known = (m.xml, m.xml, m.xml, m.array_values, m.array_values, m.payload, m.xml_depth)
    mesh, what = draw.bad(
        name, (*known, *m.ANY, *m.TEXT) if name == "ascii.vtu" else (*known, *m.ANY)
    )
    return what, *with_mesh(draw, mesh)


def field_names(draw):
    """Meshes whose fields have hostile names, in files that are well-formed."""
    mesh, what = draw.bad(
        draw.one("m.vtu", "solved.vtu", "ascii.vtu", "inline.vtu"), (m.xml_names,)
    )
    return what, *with_mesh(draw, mesh)


def vtk(draw):
    """Legacy VTK, text and binary, old and new."""
    name = draw.one("m.vtk", "ascii.vtk", "vtk51.vtk", "ascii51.vtk", "ascii51.vtk")
    mutations = m.TEXT if name.startswith("ascii5") else (m.payload, m.words, m.numbers)
    mesh, what = draw.bad(name, (*mutations, *mutations, *m.ANY))
    return what, *with_mesh(draw, mesh)


def gmsh(draw):
    """gmsh's files, 2.2 and 4.1, text and binary."""
    name = draw.one(
        "m.msh", "m.msh", "m.msh2", "q.msh", "ascii41.msh", "ascii22.msh", "binary41.msh"
    )
    mesh, what = draw.bad(
        name,
        (*m.TEXT, *m.TEXT, *m.ANY) if name != "binary41.msh" else (*m.ANY, m.payload, m.numbers),
    )
    return what, *with_mesh(draw, mesh)


def results(draw):
    """CalculiX's results."""
    draw.good("m.vtu")
    name, what = draw.bad("job.frd", (*m.TEXT, *m.TEXT, *m.ANY))
    return what, ("convert", "m.vtu", "r.vtu", "--results", name), ("r.vtu",)


def label_tables(draw):
    """Names and colours of labels."""
    name, what = draw.bad(
        draw.one("lut.txt", "snap.txt", "dseg.tsv", "slicer.csv"),
        (m.table, m.table, *m.TEXT, *m.ANY),
    )
    return what, *draw.one(
        (
            (
                "mesh",
                draw.good("i.nii"),
                "--labels",
                draw.good("labels.nii"),
                "--label-names",
                name,
                "-o",
                "out.vtu",
                *QUICK,
            ),
            ("out.vtu",),
        ),
        (("convert", draw.good("m.vtu"), "out.inp", "--label-names", name), ("out.inp",)),
        (("convert", draw.good("m.vtu"), "out.feb", "--label-names", name), ("out.feb",)),
        (("convert", draw.good("m.vtu"), "out.msh", "--label-names", name), ("out.msh",)),
        (("view", draw.good("m.vtu"), "--html", "v.html", "--label-names", name), ("v.html",)),
        (
            ("surface", draw.good("m.vtu"), "-o", "s.ply", "--interfaces", "--label-names", name),
            ("s.ply",),
        ),
    )


def phantoms(draw):
    """Phantoms in TOML."""
    name, what = draw.bad("phantom.toml", (m.toml,) * 8 + m.TEXT + m.ANY)
    return (
        what,
        ("phantom", name, "-o", "ph.nii.gz", "--labels", "l.nii.gz"),
        ("ph.nii.gz", "l.nii.gz"),
    )


def mappings(draw):
    """Mappings in TOML and CSV."""
    name = draw.one("mapping.toml", "mapping.csv", "byname.csv")
    name, what = draw.bad(
        name,
        (m.toml,) * 4 + m.TEXT + m.ANY
        if name == "mapping.toml"
        else (m.table,) * 4 + m.TEXT + m.ANY,
    )
    option = draw.one("--young", "--young", "--nu", "--density")
    more = ("--young", "3") if option != "--young" else draw.one(("--nu", name), ())
    out = draw.one("out.inp", "out.feb", "out.vtu")
    return what, ("convert", draw.good("m.vtu"), out, option, name, *more), (out,)


def texts_in_meshes(draw):
    """JSON, sets and loads that a mesh's file of ours states, as another may have written them."""
    name = draw.one("m.vtu", "solved.vtu")
    field = draw.one(
        "box",
        "label_table",
        "loads",
        "sets",
        "options",
        "inputs",
        "reactions",
        "units",
        "space",
        "image_sha256",
        "violated",
    )
    import base64

    content = draw.one(
        b"[" * 100_000,
        b'{"a":' * 50_000,
        b"9" * 5000,
        b"null",
        b"[]",
        b"{}",
        b'{"1": null}',
        b"\xff\xfe",
        b"",
        b"NaN",
        b"1e999",
        b'{"1": ["<script>hostile()</script>", [9, 9, 9]]}',
        b'[["hold", "superior"]]',
        b"hold:\x1b[31m",
        b"move:nowhere:1,2,3",
        b'{"names": {"1": "<x>", "2": "a\\u0000b"}, "colours": {"1": [NaN, 2, 3]}}',
        b'{"shape": [1e30, 1, 1]}',
        b"hold:superior\n" * 2000,
        b'{"1": "<script>hostile()</script>"}',
        b'{"shape": [12, 12, 12], "affine": "x"}',
        b'{"superior": [1, 2, 3]}',
        b"kPa\nMPa",
        b"lps",
    )
    array = (
        f'<DataArray type="UInt8" Name="{field}" NumberOfTuples="{len(content)}" '.encode()
        + b'format="ascii">'
        + b" ".join(b"%d" % byte for byte in content)
        + b"</DataArray>"
    )
    data = draw.seeds.files[name]
    head, mark, tail = data.partition(f'Name="{field}"'.encode())
    if mark:  # instead of its own
        start = head.rfind(b"<DataArray")
        data = head[:start] + array + tail[tail.find(b"</DataArray>") + 12 :]
    else:
        data = data.replace(b"<FieldData>", b"<FieldData>" + array, 1)
    draw.files[name] = data
    assert base64
    return f"{field} is {content[:50]!r}", *with_mesh(draw, name)


def names(draw):
    """Files with names that a shell, a terminal, a page or a format could mistake."""
    stem = one_of(draw.rng, HOSTILE_NAMES)
    stem = draw.one(stem, stem, "\udcff\udcfe", "caf\udce9", stem + "\udc80")
    is_input = draw.rng.random() < 0.5
    how = draw.one(
        "mesh", "mesh", "convert", "view", "quality", "surface", "phantom", "mask", "figures"
    )
    suffix = {"view": ".html", "surface": ".stl", "phantom": ".nii.gz"}.get(
        how, draw.one(*MESH_OUTPUTS)
    )
    if is_input and not (
        stem.strip("/.")
        and "/" not in stem
        and "\0" not in stem
        and len(
            stem.encode("utf-8", "surrogateescape" if "\ud800" not in stem else "surrogatepass")
        )
        < 240
    ):
        is_input = False
    # what is written lies below the case's folder
    stem = stem.lstrip("/").replace("\ud800", "\udcff")
    bad, out = (stem, "out" + suffix) if is_input else ("", stem + suffix)
    image = draw.good("i.nii", (bad or "i") + ".nii") if how in ("mesh", "figures") else ""
    mesh = (
        draw.good("m.vtu", (bad or "m") + ".vtu")
        if how in ("convert", "view", "quality", "surface")
        else ""
    )
    mask = draw.good("mask.nii", (bad or "mask") + ".nii") if how == "mask" else ""
    toml = draw.good("phantom.toml", (bad or "ph") + ".toml") if how == "phantom" else ""
    words, outputs = {
        "mesh": (("mesh", image, "-o", out, *QUICK, "--json", "o.json"), (out, "o.json")),
        "figures": (("mesh", image, "-o", "out.vtu", *QUICK, "--figures", out), ("out.vtu", out)),
        "mask": (("mesh", draw.good("f.nii"), "--mask", mask, "-o", out, *QUICK), (out,)),
        "convert": (("convert", mesh, out), (out,)),
        "view": (("view", mesh, "--html", out), (out,)),
        "quality": (("quality", mesh, "--check", "--json", stem + ".json"), (stem + ".json",)),
        "surface": (("surface", mesh, "--boundary", "-o", out), (out,)),
        "phantom": (("phantom", toml, "-o", out), (out,)),
    }[how]
    return f"{'read' if is_input else 'written'}: {stem[:40]!r}", words, outputs


def bombs(draw):
    """Small files that unpack to gigabytes, holes of 128 GB, sizes that no machine has."""
    how = draw.one(
        "gz", "mgz", "sparse", "dims", "picture", "nrrd", "mha", "vtu", "phantom", "msh", "tall"
    )
    rng = draw.rng
    if how in ("gz", "mgz"):
        name = f"bomb.{'nii.gz' if how == 'gz' else 'mgz'}"
        draw.files[name] = (
            draw.seeds.files["i.nii.gz"] if draw.rng.random() < 0.5 else b""
        ) + draw.seeds.bomb
    elif how == "sparse":
        name = draw.one(
            "sparse.nii",
            "sparse.mha",
            "sparse.vtu",
            "sparse.msh",
            "sparse.csv",
            "sparse.toml",
            "sparse.png",
            "sparse.frd",
        )
        draw.files[name] = b"special:sparse:" + draw.seeds.files.get("i" + name[6:], b"")
    elif how in ("dims", "tall"):
        head = bytearray(draw.seeds.files["i.nii"])
        sizes = draw.one(
            (3, 32767, 32767, 32767),
            (3, 2000, 2000, 2000),
            (7, 64, 64, 64, 64, 64, 64, 64),
            (3, 32767, 32767, 1),
            (3, 700, 700, 700),
        )
        head[40:56] = np.array([*sizes, 1, 1, 1, 1, 1, 1][:8], "<i2").tobytes()
        name, draw.files["d.nii"] = "d.nii", bytes(head)
    elif how == "picture":
        _, data = m.damaged_picture(rng, draw.seeds.files["p.png"])
        name, draw.files["p.png"] = "p.png", data
    elif how in ("nrrd", "mha"):
        name = f"i.{how}"
        data = draw.seeds.files[f"z.{how}" if rng.random() < 0.5 else name]
        key, longest = {"nrrd": ("sizes: ", 9999999), "mha": ("DimSize = ", 99999)}[how]
        before, *sizes = (f"{key}{n} {n} {n}".encode() for n in (12, longest, 3000, 1000))
        draw.files[name] = data.replace(before, draw.one(*sizes))
    elif how == "vtu":
        name = draw.one("ascii.vtu", "inline.vtu", "m.vtu", "appended.vtu")
        data = draw.seeds.files[name]
        count = draw.one(b"9999999999", b"9223372036854775807", b"2147483647", b"300000000")
        draw.files[name] = data.replace(
            draw.one(b'NumberOfPoints="50"', b'NumberOfCells="154"'),
            b'NumberOfPoints="' + count + b'"',
        )
        return f"{how} {count!r}", *with_mesh(draw, name)
    elif how == "msh":
        name = draw.one("ascii22.msh", "m.msh2", "ascii41.msh", "m.msh", "binary41.msh")
        data = draw.seeds.files[name]
        draw.files[name] = data.replace(
            draw.one(b"\n50\n", b"\n154\n", b" 50 1 50", b" 154 1 154"),
            draw.one(b"\n2000000000\n", b" 2000000000 1 2000000000"),
            1,
        )
        return how, *with_mesh(draw, name)
    else:
        name = "phantom.toml"
        text = draw.seeds.files[name]
        draw.files[name] = text.replace(
            b"voxel_mm = 2",
            draw.one(
                b"voxel_mm = 1e-9",
                b"voxel_mm = 0.001",
                b"voxel_mm = [24, 24, 1e-7]",
                b"voxel_mm = 0.02",
            ),
        )
        if rng.random() < 0.3:
            draw.files[name] = text.replace(b"[24, 24, 24]", b"[1e9, 1e9, 1e9]")
        return how, ("phantom", name, "-o", "ph.nii"), ("ph.nii",)
    ending = name.rsplit(".", 1)[1]
    if ending in ("vtu", "msh"):
        return f"{how} {name}", *with_mesh(draw, name)
    if ending in ("csv", "frd", "toml"):
        mesh = draw.good("m.vtu")
        words = {
            "csv": ("--young", name),
            "frd": ("--results", name),
            "toml": ("--label-names", name),
        }[ending]
        return f"{how} {name}", ("convert", mesh, "out.vtu", *words), ("out.vtu",)
    return f"{how} {name}", *with_image(draw, name, is_main=draw.rng.random() < 0.7)


def special_files(draw):
    """Pipes, devices, folders and loops where a file is wanted."""
    kind = draw.one(*SPECIAL_KINDS)
    suffix = draw.one(
        ".nii",
        ".nii.gz",
        ".mha",
        ".nrrd",
        ".png",
        ".vtu",
        ".vtk",
        ".msh",
        ".csv",
        ".txt",
        ".toml",
        ".frd",
        ".json",
        ".out",
    )
    name = "special" + suffix
    draw.files[name] = b"special:" + kind.encode()
    what = f"{kind} {suffix}"
    if suffix in (".nii", ".nii.gz", ".mha", ".nrrd", ".png"):
        return what, *with_image(draw, name)
    if suffix in (".vtu", ".vtk", ".msh"):
        return what, *with_mesh(draw, name)
    if suffix == ".out":
        name = "special" + draw.one(*MESH_OUTPUTS)
        draw.files = {name: b"special:" + kind.encode()}
        through = (name, "nowhere") if kind == "gone" else ()  # --force writes where a link leads
        return what, ("convert", draw.good("m.vtu"), name, *draw.one((), ("--force",))), through
    mesh = draw.good("m.vtu")
    words = {
        ".csv": ("convert", mesh, "out.vtu", "--young", name),
        ".txt": ("convert", mesh, "out.vtu", "--label-names", name),
        ".toml": ("convert", mesh, "out.vtu", "--nu", name, "--young", "3"),
        ".frd": ("convert", mesh, "out.vtu", "--results", name),
        ".json": ("quality", mesh, "--json", name),
    }[suffix]
    return what, words, ("out.vtu",)


# Command lines

WHOLE, REAL, MAPPING, WORD = "whole", "real", "mapping", "word"
FORMULAS = (
    "=1+1",
    "__import__('os').system('touch PWNED')",
    "9**9**9",
    "9**9**9**9*h",
    "h**1e300",
    "(" * 500 + "h" + ")" * 500,
    "-" * 3000 + "h",
    "h+" * 5000 + "h",
    "open('PWNED','w')",
    "h.__class__",
    "lambda: 0",
    "[h for h in [1]]",
    "exec('1')",
    "1 if h else 2",
    "h=1",
    "h;h",
    "h\nh",
    "exp(1e9)",
    "log(0)",
    "log(-1)*h",
    "1/0",
    "0/0",
    "h@h",
    "h//2",
    "h%2",
    "h<1",
    "not h",
    "'a'",
    "f'{h}'",
    "h[0]",
    "max(h)",
    "max(*h)",
    "abs()",
    "1e309",
    "9" * 5000,
    "0x" + "f" * 3000,
    "1j",
    "True",
    "None",
    "...",
    "\u0127",
    "\uff48",
    "h\u00b2",
    "h\x00",
    "#",
    "",
    " ",
    "\x1b[31m",
    "<script>hostile()</script>",
    "0:1,100:5",
    "100:1,0:5",
    "0:1,0:2",
    "0:1,inf:2",
    "nan:1,1:2",
    "0:-1",
    "0",
    ":",
    ",",
    "1=",
    "=1",
    "1=1=1",
    "1=2,1=3",
    "*=1,*=2",
    "1.5=2",
    "-1=2",
    "liver=2",
    "1=2,*=5",
    "nowhere.toml",
    "mapping.csv",
    "../outside.csv",
    "/etc/passwd.csv",
    "1e-320",
    "-5",
    "nan",
    "inf",
    "h",
    "-h",
    "0*h",
    "1e300*h",
    "sqrt(h-1e9)",
    "h**0.5",
)
WORDS = (
    "mean",
    "geometric",
    "harmonic",
    "power:2",
    "power:1e300",
    "power:nan",
    "power:0",
    "power:-1e9",
    "power:",
    "hill",
    "gauss",
    "nodes",
    "4",
    "4:log",
    "4:quantile",
    "0:log",
    "-1",
    "4:",
    ":log",
    "1e9",
    "99999999999",
    "all",
    "none",
    "labels",
    "labels,interfaces",
    "boundary,boundary",
    "kPa",
    "MPa",
    "GPa",
    "ras",
    "lps",
    "slide",
    "fixed",
    "fast",
    "paper",
    "octree",
    "bcc",
    "five-tet",
    "criss-cross",
    "first",
    "never",
    "auto",
    "1,2",
    "1,1,1",
    "a,b",
    "0:5,0:5,0:5",
    "5:3,:,:",
    ":,:",
    "::::",
    "0:99999999999999999999,:,:",
    "-1:5,:,:",
    "k=5",
    "k=99",
    "9=1",
    "i=" + "9" * 5000,
    "k=-1",
    "x=below:20",
    "x=below:nan",
    "a b=below:3",
    "x=point:0,0,0:1e300",
    "x=point:nan,0,0:1",
    "x=plane:0,0,0:0,0,0:1",
    "x=plane:0,0,0:1e300,1e300,1e300:1",
    "boundary=below:9",
    "=below:3",
    "x=",
    "x=y:z",
    "<x>=below:50",
    "compress:5%",
    "compress:500%",
    "compress:-1%",
    "compress:nan%",
    "hold:superior",
    "hold:nowhere",
    "hold:",
    "move:superior:1,2",
    "move:superior:1e300,0,0",
    "move:superior:nan,0,0",
    "move:superior:free,free,free",
    "pressure:boundary:inf",
    "pressure:boundary:1e300",
    "traction:superior:1,2,3",
    "spring:superior:-1",
    "spring:superior:1e300",
    "gravity:0,0,-9810",
    "gravity:1e308,1e308,1e308",
    "99999/hold:superior",
    "2/hold:superior",
    "0/hold:superior",
    "-1/hold:left",
    "1e9/hold:left",
    "9" * 5000 + "/hold:left",
    "superior",
    "Unknown",
    "left-lung",
    "1",
    "interface_1_2",
    "0,1",
    "1,1",
    "left-lung,liver",
    "liver,nowhere",
)
SOLVER_OPTIONS = {
    "--young": MAPPING,
    "--nu": MAPPING,
    "--density": MAPPING,
    "--average": WORD,
    "--bins": WORD,
    "--set": WORD,
    "--sets": WORD,
    "--load": WORD,
    "--order": WHOLE,
}
OPTIONS = {
    "mesh": {
        "--nodes": WHOLE,
        "--target-error": REAL,
        "--nodes-max": WHOLE,
        "--size-min": REAL,
        "--edge-size": REAL,
        "--edge-max": REAL,
        "--gradation": REAL,
        "--lattice": WORD,
        "--spacing": REAL,
        "--k-d": REAL,
        "--boundary": WORD,
        "--method": WORD,
        "--shape-power": REAL,
        "--min-dihedral": REAL,
        "--n-t": WHOLE,
        "--retessellate": WORD,
        "--threads": WHOLE,
        "--max-seconds": REAL,
        "--weights": WORD,
        "--label-weight": REAL,
        "--volume": WHOLE,
        "--crop": WORD,
        "--slice": WORD,
        "--background": REAL,
        "--units": WORD,
        "--space": WORD,
        "--iterations": WHOLE,
        **SOLVER_OPTIONS,
    },
    "convert": {
        "--units": WORD,
        "--space": WORD,
        "--volume": WHOLE,
        "--crop": WORD,
        "--slice": WORD,
        **SOLVER_OPTIONS,
    },
    "fem": {"--compress": REAL, "--volume": WHOLE, "--crop": WORD, **SOLVER_OPTIONS},
    "surface": {
        "--below": REAL,
        "--label": WORD,
        "--set": WORD,
        "--interface": WORD,
        "--space": WORD,
    },
    "segment": {"--classes": WHOLE, "--volume": WHOLE, "--crop": WORD, "--slice": WORD},
    "phantom": {"--voxel-mm": REAL, "--blur-mm": REAL, "--noise-sd": REAL, "--seed": WHOLE},
    "quality": {"--volume": WHOLE, "--crop": WORD, "--slice": WORD},
    "view": {"--volume": WHOLE, "--crop": WORD},
}


# What is taken where the rest of the line is sound: not everything should be refused at its first
# word.
PLAUSIBLE = {
    "--nodes": ("9", "30", "80"),
    "--target-error": ("0.5", "0.9"),
    "--nodes-max": ("40", "90"),
    "--size-min": ("1", "5"),
    "--edge-size": ("6", "12"),
    "--edge-max": ("9", "20"),
    "--gradation": ("0.3", "1"),
    "--lattice": ("bcc", "five-tet", "octree"),
    "--spacing": ("6", "9"),
    "--k-d": ("0", "0.5", "0.99"),
    "--boundary": ("slide", "fixed"),
    "--method": ("paper", "fast"),
    "--shape-power": ("1", "10"),
    "--min-dihedral": ("0", "5", "30", "69"),
    "--n-t": ("0", "1"),
    "--threads": ("1",),
    "--max-seconds": ("0.01", "1"),
    "--weights": ("2", "0"),
    "--label-weight": ("0", "100"),
    "--crop": ("2:9,:,1:7", "0:1,:,:"),
    "--slice": ("k=5", "i=0"),
    "--background": ("auto", "25"),
    "--iterations": ("0", "3"),
    "--young": ("3", "1+abs(h)", "0:1,99:5"),
    "--nu": ("0.3", "0.49"),
    "--density": ("1000",),
    "--average": ("harmonic", "mean"),
    "--bins": ("3", "4:log", "2:quantile"),
    "--set": ("a=below:50", "b=point:5,15,20:9"),
    "--load": ("hold:superior", "pressure:inferior:1", "gravity:0,0,-9810"),
    "--order": ("2", "1"),
    "--units": ("MPa",),
    "--space": ("lps",),
    "--compress": ("2",),
    "--below": ("50",),
    "--label": ("1", "liver"),
    "--interface": ("0,1",),
    "--classes": ("2", "3"),
    "--voxel-mm": ("3",),
    "--blur-mm": ("0", "3"),
    "--noise-sd": ("1",),
}


def options(draw):
    """Numbers, words, formulas and mappings on the command line."""
    command = draw.one(
        *["mesh"] * 5,
        *["convert"] * 2,
        "fem",
        "fem",
        "surface",
        "segment",
        "phantom",
        "quality",
        "view",
    )
    out = f"out{draw.one(*MESH_OUTPUTS)}"
    base, outputs = {
        "mesh": lambda: (("mesh", draw.good("i.nii"), "-o", out, *QUICK), (out,)),
        "convert": lambda: (
            ("convert", draw.good("m.vtu"), out, *draw.one((), ("--image", draw.good("i.nii")))),
            (out,),
        ),
        "fem": lambda: (
            ("fem", *draw.one((), (draw.good("i.nii"),)), draw.good("m.vtu"), "-o", "u.vtu"),
            ("u.vtu",),
        ),
        "surface": lambda: (("surface", draw.good("m.vtu"), "-o", "s.ply"), ("s.ply",)),
        "segment": lambda: (
            ("segment", draw.good("i.nii"), draw.good("m.vtu"), "-o", "seg.nii"),
            ("seg.nii",),
        ),
        "phantom": lambda: (("phantom", draw.good("phantom.toml"), "-o", "ph.nii"), ("ph.nii",)),
        "quality": lambda: (("quality", draw.good("m.vtu"), "--image", draw.good("i.nii")), ()),
        "view": lambda: (
            ("view", draw.good("m.vtu"), "--image", draw.good("i.nii"), "--html", "v.html"),
            ("v.html",),
        ),
    }[command]()
    if command == "mesh" and draw.rng.random() < 0.3:
        base += ("--labels", draw.good("labels.nii"), "--label-names", draw.good("lut.txt"))
    elif command == "mesh" and draw.rng.random() < 0.3:
        base += ("--mask", draw.good("mask.nii"))
    draw.good("mapping.csv")
    added: list[str] = []
    for _ in range(int(draw.rng.choice([1, 1, 2, 3]))):
        name = one_of(draw.rng, sorted(OPTIONS[command]))
        pool = {WHOLE: HOSTILE_NUMBERS, REAL: HOSTILE_NUMBERS, MAPPING: FORMULAS, WORD: WORDS}[
            OPTIONS[command][name]
        ]
        value = one_of(
            draw.rng, PLAUSIBLE[name] if name in PLAUSIBLE and draw.rng.random() < 0.4 else pool
        )
        value = one_of(draw.rng, HOSTILE_NAMES) if draw.rng.random() < 0.1 else value
        value = (
            value.replace("\ud800", "\udcff").replace("\0", "")
            if draw.rng.random() < 0.9
            else value
        )
        added += (
            [name, value]
            if draw.rng.random() < 0.7 or not name.startswith("--")
            else [f"{name}={value}"]
        )
    if "--iterations" in " ".join(added):
        added += ["--max-seconds", "1"]  # as many sweeps as one asks for are no fault
    position = 1 if draw.rng.random() < 0.1 else len(base)
    return " ".join(added)[:200], (*base[:position], *added, *base[position:]), outputs


def lines(draw):
    """Command lines of no form at all."""
    pool = (
        *OPTIONS,
        "--help",
        "--version",
        "-o",
        "--force",
        "i.nii",
        "m.vtu",
        "out.vtu",
        "demo",
        "paper",
        "compare",
        "--json",
        "",
        "-",
        "--",
        "@x",
        "*",
    )
    pool = (
        *pool,
        one_of(draw.rng, HOSTILE_NAMES).replace("\ud800", "\udcff"),
        one_of(draw.rng, HOSTILE_NUMBERS),
    )
    draw.good("i.nii")
    draw.good("m.vtu")
    words = [one_of(draw.rng, pool) for _ in range(int(draw.rng.integers(0, 6)))]
    words = (
        [word for word in words if word not in ("demo", "compare")] if len(words) != 1 else words
    )
    if words[:1] == ["demo"]:  # which have defaults for all they need
        words.append("--nodes=x")
    if words[:1] == ["view"] and "--html" not in words:  # which would open a window
        words += ["--html", "out.vtu"]
    return " ".join(words)[:100], tuple(words), ("out.vtu", "--json", "--force")


KINDS: dict[str, tuple[int, Callable[[Draw], tuple]]] = {
    "NIfTI": (6, nifti),
    "odd images": (6, odd_images),
    "MGH": (2, mgh),
    "NRRD, MetaImage": (5, itk),
    "DICOM": (3, dicom),
    "Zarr": (4, zarr_volumes),
    "pictures": (2, pictures),
    "VTU": (7, vtu),
    "legacy VTK": (4, vtk),
    "gmsh": (5, gmsh),
    "CalculiX's results": (2, results),
    "field names": (2, field_names),
    "texts in meshes": (3, texts_in_meshes),
    "label tables": (3, label_tables),
    "phantoms": (4, phantoms),
    "mappings in files": (3, mappings),
    "options": (9, options),
    "command lines": (2, lines),
    "file names": (4, names),
    "bombs": (2, bombs),
    "outside": (1, outside),
    "special files": (2, special_files),
}
WHEEL = [kind for kind, (weight, _) in KINDS.items() for _ in range(weight)]


def case_of(seeds: Seeds, seed: int, number: int) -> Case:
    """The case of a seed and number, always the same."""
    draw = Draw(seeds, seed, number)
    kind = (
        WHEEL[(number * 37 + seed) % len(WHEEL)] if number < len(WHEEL) else one_of(draw.rng, WHEEL)
    )
    what, words, outputs = KINDS[kind][1](draw)
    words = tuple(word.replace("\ud800", "\udcff") for word in words)
    return Case(kind, what, words, draw.files, outputs, kind == "outside")
