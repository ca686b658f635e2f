"""What is done to a valid file: mutations that know its format, and some that know none.

Each takes a numpy Generator and the file's bytes, and returns the words for what was done and the
bytes.
"""

import gzip
import re
import struct
import zlib

import nibabel
import numpy as np
from nibabel.freesurfer.mghformat import header_dtype as mgh_dtype
from nibabel.nifti1 import header_dtype as nifti1_dtype
from nibabel.nifti2 import header_dtype as nifti2_dtype

HOSTILE_NUMBERS = (
    "0",
    "-1",
    "-0",
    "1",
    "2",
    "3",
    "7",
    "32767",
    "65535",
    "65536",
    "2147483647",
    "2147483648",
    "-2147483648",
    "4294967295",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
    "1e30",
    "-1e30",
    "1e300",
    "1e308",
    "1e309",
    "-1e309",
    "1e-300",
    "5e-324",
    "1e-20",
    "1e20",
    "1e6",
    "0.1",
    "nan",
    "-nan",
    "inf",
    "-inf",
    "NaN",
    "Infinity",
    "1.5",
    "1,5",
    "1e",
    "0x10",
    "1_000",
    "\u0663",
    "",
    " ",
    "abc",
    "--",
    "+",
    "1 2",
    "9" * 400,
    "9" * 5000,
    "1" + "0" * 20,
    "-" + "9" * 30,
    "0." + "0" * 400 + "1",
    "true",
    "null",
    "[]",
    "{}",
    "'",
    '"',
    "%s%n",
    "{0}",
    "$HOME",
)
HOSTILE_NAMES = (
    "[bold]x[/bold]",
    "[/]",
    "[link=http://x]y[/link]",
    "<x>",
    'a"b',
    "a'b",
    "a&b",
    "a<b>&amp;",
    "]]>",
    "--><script>hostile()</script>",
    "<script>hostile()</script>",
    "<img src=x onerror=hostile()>",
    "\x1b[31mred\x1b[0m",
    "a\x07b",
    "tab\there",
    "new\nline",
    "cr\rlf\r\n",
    "a\x00b",
    "\x7f",
    "\x85",
    "\u202egnp.exe",
    "\u200b",
    "e\u0301",
    "\U0001f4a3",
    "*KEYWORD",
    "*END STEP",
    "$EndElements",
    "$HOME",
    "$(touch PWNED)",
    "`touch PWNED`",
    ";touch PWNED",
    "|touch PWNED",
    "{{7*7}}",
    "%s%s%n",
    "{0.__class__}",
    "=1+1",
    "-o",
    "--help",
    "../up",
    "/abs",
    "a/b",
    "a\\b",
    "CON",
    "nul",
    ".",
    "..",
    "~",
    "x" * 200,
    "x" * 5000,
    " ",
    "",
    ",",
    ":",
    "a,b",
    "a:b",
    "a=b",
    "*",
    "#c",
    "\\",
    '"',
    "'",
    "\ufeff",
    "\ud800",
    "None",
    "nan",
    "1",
    "-1",
    "All",
    "label_1",
    "boundary",
    "interface_1_2",
)
CONTROLS = (
    "\x00",
    "\x01",
    "\x08",
    "\x0b",
    "\x0c",
    "\x1b[2J",
    "\x7f",
    "\x85",
    "\u2028",
    "\ufeff",
    "\r",
    "\t",
)
OUTSIDE = (
    "../outside.raw",
    "/etc/passwd",
    "file:///etc/passwd",
    "http://127.0.0.1:9/x.raw",
    "../../outside.raw",
    "/dev/zero",
    "/dev/stdin",
)
XML_BOMB = (
    "<!DOCTYPE z ["
    + '<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
    + "]>"
)
XML_OUTSIDE = '<!DOCTYPE z [<!ENTITY a11 SYSTEM "file:///etc/passwd">]>'


def one_of(rng, values):
    """One of a sequence."""
    return values[int(rng.integers(len(values)))]


# Of any file


def cut(rng, data):
    """The file ends too soon."""
    at = int(rng.integers(max(len(data), 1)))
    return f"cut at byte {at} of {len(data)}", data[:at]


def flipped(rng, data):
    """Some bits are others."""
    array = np.frombuffer(data, np.uint8).copy()
    n = int(rng.choice([1, 1, 2, 5, 20, 200]))
    reach = len(array) if rng.random() < 0.5 else min(len(array), 400)  # headers come first
    for _ in range(n if reach else 0):
        array[rng.integers(reach)] ^= np.uint8(1 << rng.integers(8))
    return f"{n} bits flipped in the first {reach} bytes", array.tobytes()


def overwritten(rng, data):
    """Some bytes in a row are all the same, or numbers of 2, 4, 8 bytes at their extremes."""
    array = bytearray(data)
    patch = one_of(
        rng,
        [
            b"\x00",
            b"\xff",
            b"\xff\xff\xff\x7f",
            b"\x00\x00\x00\x80",
            b"\xff" * 8,
            b"\xff" * 7 + b"\x7f",
            b"\x7f\xff\xff\xff",
            struct.pack("<d", np.nan),
            struct.pack("<d", np.inf),
            struct.pack("<f", np.nan),
            struct.pack("<d", 1e300),
            b"\x00" * 64,
        ],
    )
    at = int(rng.integers(max(len(data) if rng.random() < 0.5 else min(len(data), 400), 1)))
    array[at : at + len(patch)] = patch
    return f"{patch[:8].hex()} at byte {at}", bytes(array)


def rearranged(rng, data):
    """A piece is doubled, left out, put elsewhere, or replaced by noise."""
    a, b = sorted(rng.integers(len(data) + 1, size=2).tolist())
    b = min(b, a + 4000)
    how = one_of(rng, ["doubled", "left out", "moved to the start", "noise", "repeated 50 times"])
    piece = data[a:b]
    changed = {
        "doubled": data[:b] + piece + data[b:],
        "left out": data[:a] + data[b:],
        "moved to the start": piece + data[:a] + data[b:],
        "noise": data[:a] + rng.bytes(b - a) + data[b:],
        "repeated 50 times": data[:a] + piece * 50 + data[b:],
    }[how]
    return f"bytes {a} to {b} {how}", changed


def replaced(rng, data):
    """Something else altogether."""
    choices = {
        "empty": b"",
        "one zero byte": b"\0",
        "a million zeros": bytes(1_000_000),
        "noise": rng.bytes(3000),
        "a line": b"hello\n",
        "HTML": b"<!DOCTYPE html><html><body>404</body></html>",
        "gzip of nothing": gzip.compress(b""),
        "ff": b"\xff" * 5000,
        "UTF-16": "\ufeffhello".encode("utf-16"),
        "open brackets": b"[" * 100_000,
        "open tags": b"<a>" * 100_000,
        "half the file twice": data[: len(data) // 2] * 2,
        "pickle": b"cos\nsystem\n(S'touch PWNED'\ntR.",
    }
    what = one_of(rng, sorted(choices))
    return what, choices[what]


def packed_head(rng, data):
    """A byte or a number in the head that a codec puts before what it has packed."""
    array, at = bytearray(data), int(rng.integers(min(len(data), 20) or 1))
    size = int(one_of(rng, [1, 1, 2, 4, 8]))
    number = int(
        one_of(
            rng,
            [
                0,
                1,
                2,
                127,
                255,
                2**15,
                2**31 - 1,
                2**31,
                2**32 - 1,
                2**63 - 1,
                len(data),
                5 * len(data),
            ],
        )
    )
    array[at : at + size] = (number % 256**size).to_bytes(size, "little")
    return f"{number} in {size} bytes at {at}", bytes(array)


def packed_worse(rng, data):
    """Packed by gzip, with that file damaged, or twice, or with rubbish behind it."""
    packed = gzip.compress(data, mtime=0)
    how = one_of(rng, ["cut", "flip", "twice", "rubbish", "length", "members"])
    if how == "cut":
        return cut(rng, packed)
    if how == "flip":
        return flipped(rng, packed)
    changed = {
        "twice": gzip.compress(packed, mtime=0),
        "rubbish": packed + b"rubbish",
        "length": packed[:-4] + b"\xff\xff\xff\xff",
        "members": packed * 20,
    }[how]
    return f"gzip: {how}", changed


ANY = (cut, flipped, overwritten, rearranged, replaced)


# Of headers of fixed fields


def _extreme(rng, dtype):
    """A number that no sane writer has put there."""
    if dtype.kind == "f":
        values = [
            0,
            -1,
            np.nan,
            np.inf,
            -np.inf,
            1e-300,
            1e300,
            1e30,
            -1e30,
            1e-30,
            1e-6,
            1e6,
            5e-324,
            1e20,
            3.4e38,
        ]
    elif dtype.kind in "iu":
        info = np.iinfo(dtype)
        values = [
            0,
            -1,
            1,
            2,
            3,
            7,
            8,
            16,
            64,
            255,
            1000,
            32767,
            info.max,
            info.min,
            info.max // 2,
            1 << 20,
            1 << 40,
        ]
    else:
        return one_of(
            rng,
            [
                b"",
                b"\xff" * 80,
                b"../outside",
                b"n+1\0",
                b"ni1\0",
                b"\0" * 80,
                b"\x1b[31m",
                b"%s%n",
            ],
        )[: dtype.itemsize]
    value = one_of(rng, values)
    with np.errstate(all="ignore"):
        if dtype.kind in "iu":
            return int(np.clip(value, np.iinfo(dtype).min, np.iinfo(dtype).max))
        return dtype.type(value)


def _with_fields(rng, data, dtype, weights=()):
    """Up to three header fields at extremes; those of `weights` more often."""
    head = np.frombuffer(data[: dtype.itemsize].ljust(dtype.itemsize, b"\0"), dtype).copy()
    words = []
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        name = one_of(rng, weights if len(weights) and rng.random() < 0.6 else dtype.names)
        kind = dtype[name]
        value = _extreme(rng, kind.base)
        if kind.shape:
            index = tuple(int(rng.integers(n)) for n in kind.shape)
            head[name][(0, *index)] = value
            words.append(f"{name}{list(index)} = {value!r}")
        else:
            head[name][0] = value
            words.append(f"{name} = {value!r}")
    return ", ".join(words), head.tobytes() + data[dtype.itemsize :]


def nifti(rng, data):
    """Fields of NIfTI-1's or NIfTI-2's header."""
    is_first = data[:4] == struct.pack("<i", 348)
    dtype = nifti1_dtype if is_first else nifti2_dtype
    of_interest = (
        "dim",
        "pixdim",
        "datatype",
        "bitpix",
        "vox_offset",
        "scl_slope",
        "scl_inter",
        "qform_code",
        "sform_code",
    )
    of_interest += (
        "srow_x",
        "srow_y",
        "srow_z",
        "quatern_b",
        "quatern_c",
        "qoffset_x",
        "magic",
        "xyzt_units",
        "sizeof_hdr",
    )
    return _with_fields(rng, data, dtype.newbyteorder("<"), of_interest)


def mgh(rng, data):
    """Fields of MGH's header."""
    return _with_fields(rng, data, np.dtype(mgh_dtype).newbyteorder(">"))


def affines(rng, data):
    """A NIfTI-1 image somewhere odd: sheared, thin, huge, tiny, nearly flat, or not anywhere."""
    matrix = np.eye(4)
    how = one_of(
        rng, ["aspect", "shear", "tiny", "huge", "flat", "far", "nan", "mirror", "zero column"]
    )
    size = float(10.0 ** rng.integers(1, 31))
    axis, other = rng.permutation(3)[:2]
    if how == "aspect":
        matrix[axis, axis] = size
    elif how == "shear":
        matrix[axis, other] = size
    elif how in ("tiny", "huge"):
        matrix[:3, :3] *= size if how == "huge" else 1.0 / size
    elif how == "flat":
        matrix[:, axis] = matrix[:, other] * (1 + 1.0 / size)
    elif how == "far":
        matrix[axis, 3] = size
    elif how == "nan":
        matrix[axis, other] = np.nan
    elif how == "mirror":
        matrix[axis] *= -1
    else:
        matrix[:3, axis] = 0.0
    head = np.frombuffer(data[:348], nifti1_dtype).copy()
    with np.errstate(over="ignore"):
        head["srow_x"][0], head["srow_y"][0], head["srow_z"][0] = matrix[:3].astype(np.float32)
    head["sform_code"], head["qform_code"] = 1, 0
    return f"affine: {how} {size:g}", head.tobytes() + data[348:]


def voxels(rng, data):
    """A NIfTI-1 image of floats with values that no scanner has."""
    image = nibabel.Nifti1Image.from_bytes(data)
    array = np.array(image.dataobj, dtype=np.float64)
    low, high = one_of(
        rng,
        [
            (0, 1e-300),
            (0, 1e300),
            (-1e300, 1e300),
            (1, 1 + 1e-15),
            (0, 5e-324),
            (1e15, 1e15 + 1),
            (0, 1e154),
            (-1e-160, 1e-160),
            (0, 1e38),
        ],
    )
    how = one_of(
        rng,
        [
            "scaled",
            "one voxel",
            "nan",
            "inf",
            "constant",
            "half nan",
            "noise",
            "checkers",
            "scaled",
        ],
    )
    unit = (array - array.min()) / np.ptp(array)
    if how == "scaled":
        array = low + unit * (high - low) if np.isfinite(high - low) else unit * high
    elif how == "one voxel":
        array[tuple(rng.integers(array.shape))] = high
    elif how in ("nan", "inf"):
        array[tuple(rng.integers(array.shape))] = float(how)
    elif how == "constant":
        array[:] = high
    elif how == "half nan":
        array[: len(array) // 2] = np.nan
    elif how == "noise":
        array = rng.normal(size=array.shape) * min(high, 1e150)
    else:
        array = (np.indices(array.shape).sum(axis=0) % 2) * high
    return f"voxels {how}, {low:g} to {high:g}", nibabel.Nifti1Image(array, image.affine).to_bytes()


def shapes(rng, data):
    """A NIfTI-1 image of another, honest shape."""
    image = nibabel.Nifti1Image.from_bytes(data)
    sizes = one_of(
        rng,
        [
            (1, 1, 1),
            (1, 12, 12),
            (12, 12, 1),
            (2, 2, 2),
            (1, 1, 400),
            (3, 3, 300),
            (12,),
            (12, 12),
            (2, 3),
            (0, 4, 4),
            (4, 4, 4, 3),
            (4, 4, 4, 1, 3),
            (5, 5, 5, 0),
        ],
    )
    array = rng.integers(0, 50, sizes).astype(np.int16)
    return f"shape {sizes}", nibabel.Nifti1Image(array, image.affine).to_bytes()


def dicom(rng, data):
    """A tag's value or length in a DICOM file."""
    places = [m.start() for m in re.finditer(rb"(?s)[\x02-\x7f]\x00..[A-Z][A-Z]", data[132:])]
    if not places:
        return flipped(rng, data)
    at = 132 + one_of(rng, places)
    array = bytearray(data)
    how = one_of(rng, ["length", "value", "tag", "type", "size", "place"])
    if how == "length":
        array[at + 6 : at + 8] = one_of(rng, [b"\xff\xff", b"\0\0", b"\x01\0", b"\xff\x7f"])
    elif how == "value":
        n = int.from_bytes(data[at + 6 : at + 8], "little")
        array[at + 8 : at + 8 + n] = one_of(rng, [b"\xff", b"\0", b"9", b"\\", b"-", b"<"]) * n
    elif how == "tag":
        array[at : at + 4] = rng.bytes(4)
    elif how == "type":
        array[at + 4 : at + 6] = one_of(rng, [b"SQ", b"OB", b"UN", b"FD", b"UL", b"US", b"XX"])
    elif (
        how == "size"
        and (
            spot := data.find(
                one_of(
                    rng,
                    [b"\x28\0\x10\0US", b"\x28\0\x11\0US", b"\x28\0\0\x01US", b"\x28\0\x02\0US"],
                )
            )
        )
        > 0
    ):
        array[spot + 8 : spot + 10] = one_of(
            rng, [b"\0\0", b"\xff\xff", b"\x01\0", b"\xff\x7f", b"\x40\0"]
        )
    elif (spot := data.find(one_of(rng, [b"5\\-7\\", b"1\\0\\0\\0\\1\\0", b"2\\2"]))) > 0:
        text = one_of(
            rng,
            [
                b"nan\\nan\\n",
                b"1e99\\1e9",
                b"0\\0\\0\\0\\0\\0",
                b"inf\\",
                b"a\\b\\c",
                b"\\\\\\",
                b"-1\\-1",
            ],
        )
        array[spot : spot + len(text)] = text
    return f"DICOM: {how} at {at}", bytes(array)


# Of texts


def _split_text(data):
    return data.decode("latin-1")


def numbers(rng, data):
    """Some numbers of a text are others."""
    text = _split_text(data)
    places = [
        m.span()
        for m in re.finditer(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])", text[:200_000])
    ]
    words = []
    for _ in range(int(rng.choice([1, 1, 1, 2, 5])) if places else 0):
        if not places:
            break
        near = places[: max(len(places) // 10, 12)] if rng.random() < 0.6 else places
        a, b = one_of(rng, near)
        value = one_of(rng, HOSTILE_NUMBERS)
        words.append(f"{text[a:b]} at {a} is {value[:20]!r}")
        text = text[:a] + value + text[b:]
        places = [(c, d) for c, d in places if d <= a]
    return "; ".join(words) or "nothing", text.encode(
        "utf-8" if not text.isascii() and "\u0663" in text else "latin-1", "replace"
    )


def lines(rng, data):
    """A line is left out, doubled, moved, garbled, or very long."""
    rows = _split_text(data).split("\n")
    k = (
        int(rng.integers(min(len(rows), 60)))
        if rng.random() < 0.6
        else int(rng.integers(len(rows)))
    )
    how = one_of(
        rng,
        [
            "left out",
            "doubled",
            "last",
            "garbled",
            "long",
            "control",
            "non-UTF-8",
            "1000 times",
            "blank",
            "first",
        ],
    )
    row = rows[k]
    if how == "left out":
        del rows[k]
    elif how == "doubled":
        rows.insert(k, row)
    elif how in ("last", "first"):
        del rows[k]
        rows.insert(len(rows) if how == "last" else 0, row)
    elif how == "garbled":
        rows[k] = "".join(rng.permutation(list(row)).tolist())
    elif how == "long":
        rows[k] = row + "x" * 1_000_000
    elif how == "control":
        at = int(rng.integers(len(row) + 1))
        rows[k] = row[:at] + one_of(rng, CONTROLS[:7]) + row[at:]
    elif how == "non-UTF-8":
        at = int(rng.integers(len(row) + 1))
        rows[k] = row[:at] + "\xff\xfe\xe9" + row[at:]
    elif how == "1000 times":
        rows[k:k] = [row] * 1000
    else:
        rows.insert(k, "")
    return f"line {k + 1} {how}", "\n".join(rows).encode("latin-1", "replace")


def words(rng, data):
    """A word of a text is another, or a hostile name."""
    text = _split_text(data)
    places = [m.span() for m in re.finditer(r"[A-Za-z_][\w-]*", text[:100_000])]
    if not places:
        return flipped(rng, data)
    a, b = one_of(rng, places[:120] if rng.random() < 0.7 else places)
    other = one_of(rng, places[:120])
    new = text[other[0] : other[1]] if rng.random() < 0.4 else one_of(rng, HOSTILE_NAMES)
    changed = (
        text[:a].encode("latin-1")
        + new.encode("utf-8", "surrogatepass")
        + text[b:].encode("latin-1")
    )
    return f"{text[a:b]!r} is {new[:30]!r}", changed


TEXT = (numbers, numbers, lines, words)


def key_values(rng, data):
    """A value in the head of NRRD or MetaImage: an extreme, or of another key."""
    end = data.find(b"\n\n") if data.startswith(b"NRRD") else data.find(b"ElementDataFile")
    end = len(data) if end < 0 else data.find(b"\n", end + 1)
    end = len(data) if end < 0 else end
    rows = data[:end].decode("latin-1").split("\n")
    spots = [k for k, row in enumerate(rows) if "=" in row or ": " in row]
    if not spots:
        return flipped(rng, data)
    k = one_of(rng, spots)
    mark = "=" if "=" in rows[k] else ":"
    key, _, value = rows[k].partition(mark)
    how = one_of(
        rng, ["number", "all numbers", "other", "kind", "left out", "long", "more", "fewer"]
    )
    parts = value.split()
    if how == "number" and parts:
        parts[int(rng.integers(len(parts)))] = one_of(rng, HOSTILE_NUMBERS)
        value = " ".join(parts)
    elif how == "all numbers":
        value = " ".join([one_of(rng, HOSTILE_NUMBERS)] * max(len(parts), 1))
    elif how == "other":
        value = rows[one_of(rng, spots)].partition(mark)[2]
    elif how == "kind":
        value = one_of(
            rng,
            [
                "MET_DOUBLE",
                "MET_UCHAR_ARRAY",
                "MET_OTHER",
                "MET_LONG_LONG",
                "double",
                "block",
                "gzip",
                "bzip2",
                "raw",
                "hex",
                "ascii",
                "True",
                "False",
                "LIST",
                "x%03d.raw 1 100000 1",
            ],
        )
    elif how == "left out":
        del rows[k]
    elif how == "long":
        value = " ".join(["1"] * 3000)
    elif how == "more":
        value += " 1 1 1"
    else:
        value = " ".join(parts[:1])
    if how != "left out":
        rows[k] = f"{key}{mark} {value}"
    return f"{key.strip()}: {how} {value[:30]!r}", "\n".join(rows).encode(
        "utf-8", "replace"
    ) + data[end:]


def outside(rng, data):
    """The data file that a header names lies somewhere else: to be refused."""
    target = one_of(rng, OUTSIDE).encode()
    changed = re.sub(rb"(ElementDataFile = |data file: )[^\n]*", lambda m: m[1] + target, data)
    return f"data in {target.decode()}", changed


# Of XML


def xml(rng, data):
    """Attributes of VTU's XML, its lengths and its encodings."""
    places = [m.span(2) for m in re.finditer(rb'(?<=\s)([\w-]+)="([^"]*)"', data[:60_000])]
    if not places:
        return flipped(rng, data)
    a, b = one_of(rng, places)
    pools = (
        HOSTILE_NUMBERS,
        HOSTILE_NAMES,
        (
            "Int8",
            "UInt64",
            "Float32",
            "String",
            "Bit",
            "IdType",
            "ascii",
            "binary",
            "appended",
            "base64",
            "raw",
            "BigEndian",
            "UInt32",
        ),
        (
            "vtkZLibDataCompressor",
            "vtkLZ4DataCompressor",
            "vtkLZMADataCompressor",
            "PolyData",
            "PUnstructuredGrid",
            "connectivity",
            "types",
        ),
    )
    value = one_of(rng, one_of(rng, pools))
    if rng.random() < 0.7:
        for plain, escaped in (("&", "&amp;"), ("<", "&lt;"), ('"', "&quot;")):
            value = value.replace(plain, escaped)
    changed = data[:a] + value.encode("utf-8", "surrogatepass") + data[b:]
    return f"{data[max(a - 20, 0) : b].decode('latin-1')[:60]!r} is {value[:30]!r}", changed


def xml_names(rng, data):
    """The names of fields are hostile, and the file is well-formed: a good reader takes it."""
    names = [
        name
        for name in HOSTILE_NAMES
        if name and all(c >= " " and not "\ud800" <= c <= "\udfff" for c in name)
    ]
    chosen = []

    def renamed(match):
        name = one_of(rng, names)
        chosen.append(name)
        for plain, escaped in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
            name = name.replace(plain, escaped)
        return b'Name="' + name.encode() + b'"'

    head, mark, tail = data.partition(b"<CellData")
    inner, end, rest = tail.partition(b"</CellData>")
    inner = re.sub(rb'Name="[^"]*"', lambda m: renamed(m) if rng.random() < 0.4 else m[0], inner)
    return f"fields called {', '.join(map(repr, chosen))[:200]}", head + mark + inner + end + rest


def xml_bomb(rng, data):
    """Entities that expand to gigabytes, or to a file of the system: to be refused, or left as
    they are.
    """
    doctype = XML_BOMB if rng.random() < 0.5 else XML_OUTSIDE
    head, mark, rest = data.partition(b"<VTKFile")
    spot = rest.find(b'Name="')
    if rng.random() < 0.5 and spot > 0:
        rest = rest[: spot + 6] + b"&a11;" + rest[spot + 6 :]
    else:
        rest = rest.replace(b"</DataArray>", b"&a11;</DataArray>", 1)
    return doctype[:24], head + doctype.encode() + mark + rest


def xml_depth(rng, data):
    """Elements within elements, a hundred thousand deep."""
    tag = one_of(rng, [b"a", b"Piece", b"DataArray"])
    return f"deep in <{tag.decode()}>", data.replace(
        b"<Piece", b"<" + tag + b">" * 1 + (b"<" + tag + b">") * 100_000 + b"<Piece", 1
    )


def array_values(rng, data):
    """Values of one array in VTU's text, or the bytes of one that is packed inline."""
    spans = [m.span(2) for m in re.finditer(rb"(?s)<DataArray([^>]*)>(.*?)</DataArray>", data)]
    if not spans:
        return overwritten(rng, data)
    a, b = one_of(rng, spans)
    inner = data[a:b].strip()
    if re.fullmatch(rb"[\s\d.eE+-]+", inner):
        tokens = inner.split()
        for _ in range(int(rng.choice([1, 1, 3, len(tokens)]))):
            tokens[int(rng.integers(len(tokens)))] = one_of(rng, HOSTILE_NUMBERS).encode()
        return f"array at {a}", data[:a] + b"\n" + b" ".join(tokens) + b"\n" + data[b:]
    word, changed = one_of(rng, (cut, flipped, rearranged))(rng, inner)
    return f"array at {a}: {word}", data[:a] + changed + data[b:]


def payload(rng, data):
    """The length of appended data, or of legacy VTK's binary blocks, or bytes in them."""
    at = data.find(b"_", max(data.find(b"<AppendedData"), 0)) + 1
    if at == 0 or b"<AppendedData" not in data:
        at = int(rng.integers(len(data)))
    array = bytearray(data)
    array[at : at + 8] = one_of(
        rng,
        [
            b"\xff" * 8,
            b"\xff" * 7 + b"\x7f",
            b"\0" * 8,
            b"\0\0\0\x80\0\0\0\0",
            b"\xff\xff\xff\x7f\0\0\0\0",
        ],
    )
    return f"length at {at}", bytes(array)


# Of TOML


def toml_value(rng):
    """A value as TOML writes it, or nearly."""
    big = "9" * 5000
    return one_of(
        rng,
        [
            "0",
            "-1",
            "nan",
            "inf",
            "-inf",
            "1e308",
            "1e400",
            "1e-320",
            "true",
            '""',
            '"x"',
            "[]",
            "[[]]",
            "{}",
            big,
            f"-{big}",
            f"[{big}]",
            "0x" + "f" * 5000,
            "[1, 2]",
            "[1, 2, 3, 4]",
            "[1, 2, nan]",
            "[1e30, 1, 1]",
            "[1e-30, 1, 1]",
            "[0, 0, 0]",
            "1979-05-27",
            "[" * 3000 + "]" * 3000,
            "{a=" * 500 + "1" + "}" * 500,
            '"<script>hostile()</script>"',
            '"\\u001b[31m"',
            '"a\\nb"',
            '"\\u0000"',
            '"[bold]x[/]"',
            '["a", 1, 2]',
            "1e6",
            "1e-6",
            "1000000",
            "2147483648",
            "0.001",
            '"../outside"',
            '"""' + "x" * 10000 + '"""',
            "[1000, 1000, 1000]",
            "[24, 24, 1e-9]",
            "9007199254740993",
            "1.5",
        ],
    )


def toml(rng, data):
    """A value of TOML is another, or a key is unknown, doubled or gone."""
    rows = data.decode().split("\n")
    spots = [k for k, row in enumerate(rows) if "=" in row]
    k = one_of(rng, spots)
    key = rows[k].split("=")[0].strip()
    how = one_of(rng, ["value", "value", "value", "key", "doubled", "gone", "nested", "many"])
    if how == "value":
        rows[k] = f"{key} = {toml_value(rng)}"
    elif how == "key":
        keys = ["x", "kind", "__class__", "a.b.c", "size_mm.x", "shape", "[shape]"]
        rows[k] = f"{one_of(rng, keys)} = {toml_value(rng)}"
    elif how == "doubled":
        rows.insert(k, rows[k])
    elif how == "gone":
        del rows[k]
    elif how == "nested":
        rows[k] = ".".join(["a"] * int(rng.choice([10, 900, 5000]))) + " = 1"
    else:
        rows += [
            "[[shape]]",
            'kind = "ellipsoid"',
            "center_mm = [0, 0, 0]",
            "radii_mm = 3",
            "intensity = 1",
            "label = 1",
        ] * 300
    return f"{key}: {how} {rows[min(k, len(rows) - 1)][:60]!r}", "\n".join(rows).encode()


def table(rng, data):
    """Columns of a table are wrong: a cell, a name, a column too many or too few."""
    rows = data.decode().split("\n")
    k = int(rng.integers(len(rows)))
    mark = next((each for each in ("\t", ",", " ") if each in rows[k]), ",")
    cells = rows[k].split(mark)
    spot = int(rng.integers(len(cells)))
    how = one_of(rng, ["cell", "cell", "name", "fewer", "more", "quote", "swap"])
    if how == "cell":
        cells[spot] = one_of(rng, HOSTILE_NUMBERS)
    elif how == "name":
        cells[spot] = one_of(rng, HOSTILE_NAMES)
    elif how == "fewer":
        del cells[spot]
    elif how == "more":
        cells += ["1"] * int(rng.choice([1, 3, 2000]))
    elif how == "quote":
        cells[spot] = '"' + cells[spot]
    else:
        cells = cells[::-1]
    rows[k] = mark.join(cells)
    return f"row {k + 1} {how} {rows[k][:50]!r}", "\n".join(rows).encode("utf-8", "surrogatepass")


def unpacked(mutation):
    """The mutation of what a gzip file holds, packed again."""

    def changed(rng, data):
        word, inner = mutation(rng, gzip.decompress(data))
        return word, gzip.compress(inner, 1, mtime=0)

    return changed


def damaged_picture(rng, data):
    """A picture's sizes, with the checksum of PNG put right."""
    array = bytearray(data)
    if data.startswith(b"\x89PNG"):
        array[16 + 4 * int(rng.integers(2)) :][:4] = b""
        at = 16 + 4 * int(rng.integers(2))
        array = bytearray(data)
        array[at : at + 4] = one_of(
            rng,
            [b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\0\x01\0\0", b"\0\0\x40\0", b"\xff\xff\xff\xff"],
        )
        array[29:33] = zlib.crc32(bytes(array[12:29])).to_bytes(4, "big")
        return f"PNG size at {at}", bytes(array)
    return overwritten(rng, data)
