"""Pictures that are unlike the others: turned, cut off, of another contrast."""

import numpy as np
import PIL.Image
import pytest
from cohorts import run_of, save_run, thumbnail

from tetopt.cohort.flags import flags_of
from tetopt.cohort.likeness import THUMBNAIL_BYTES, likenesses
from tetopt.cohort.numbers import Row, collect
from tetopt.image import Image
from tetopt.report.thumbnail import thumbnail_png
from tetopt.start.lattice import lattice_mesh


def saved(path, pixels):
    PIL.Image.fromarray(pixels.astype(np.uint8)).save(path, "PNG")
    return path


@pytest.fixture
def usual(tmp_path):
    """Ten pictures that differ a little."""
    rng = np.random.default_rng(0)
    smooth = 120.0 + 100.0 * np.sin(np.arange(128)[:, None] / 20.0) * np.cos(np.arange(256) / 31.0)
    return [saved(tmp_path / f"{k}.png", np.clip(smooth + rng.normal(0, 9, (128, 256)), 0, 255)) for k in range(10)]


def test_likeness_is_the_correlation_with_the_median(usual):
    blocks = [np.asarray(PIL.Image.open(path), float).reshape(32, 4, 64, 4).mean(axis=(1, 3)).ravel() for path in usual]
    centred = np.array([(each - each.mean()) / np.linalg.norm(each - each.mean()) for each in blocks])
    expected = [np.corrcoef(each, np.median(centred, axis=0))[0, 1] for each in blocks]
    np.testing.assert_allclose([each.likeness for each in likenesses(usual)], expected, rtol=1e-5)
    assert min(expected) > 0.99


def test_contrast_and_brightness_do_not_count_but_turning_does(usual, tmp_path):
    pixels = np.asarray(PIL.Image.open(usual[0]), float)
    paler = saved(tmp_path / "paler.png", 100.0 + 0.3 * pixels)
    turned, inverted = saved(tmp_path / "turned.png", pixels[::-1]), saved(tmp_path / "other.png", 255.0 - pixels)
    likeness = [each.likeness for each in likenesses([*usual, paler, turned, inverted])]
    assert likeness[-3] > 0.99
    assert likeness[-1] < -0.9
    assert likeness[-2] < 0.5


def test_each_turn_is_that_of_both_views(usual, tmp_path):
    """A picture turned over is as like the others' turned over as it was like them before."""
    pixels = np.asarray(PIL.Image.open(usual[0]), float)
    axial, sagittal = pixels[:, :128], pixels[:, 128:]
    turned = {
        "left_right": (axial[:, ::-1], sagittal), "back_front": (axial[::-1], sagittal[:, ::-1]),
        "upside_down": (axial, sagittal[::-1]),
    }  # fmt: skip
    before = likenesses(usual)[0].likeness
    for name, views in turned.items():
        own = likenesses([*usual, saved(tmp_path / f"{name}.png", np.hstack(views))])[-1]
        assert getattr(own, name) > 0.0
        assert own.likeness + getattr(own, name) == pytest.approx(before, abs=0.01)


def test_what_is_no_picture_of_ours_has_none(usual, tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "cut.png").write_bytes(usual[0].read_bytes()[:300])
    (tmp_path / "big.png").write_bytes(bytes(THUMBNAIL_BYTES + 1))
    small = saved(tmp_path / "small.png", np.arange(64.0).reshape(8, 8))
    flat = saved(tmp_path / "flat.png", np.full((128, 256), 7))
    alone = saved(tmp_path / "alone.png", np.arange(128.0 * 128).reshape(128, 128) % 200)  # the only one of its size
    names = [tmp_path / f"{name}.png" for name in ("text", "cut", "big", "missing")]
    odd = [*names, small, small, flat, alone, None]
    assert likenesses([*odd, *usual])[: len(odd)] == [None] * len(odd)
    assert likenesses([flat, flat]) == [None, None]
    assert likenesses([]) == []


def test_a_subject_cut_off_is_flagged(tmp_path):
    """Though its header and its numbers say nothing of it."""
    rng = np.random.default_rng(3)
    for k in range(20):
        save_run(tmp_path, f"sub-{k}", run_of(rng), thumbnail(rng))
    path = tmp_path / "sub-7" / "figures" / "thumbnail.png"
    pixels = np.asarray(PIL.Image.open(path).convert("L"))
    saved(path, np.where(np.arange(128)[:, None] < 64, pixels, 0))
    flags = flags_of(collect(tmp_path))
    assert [k for k, each in enumerate(flags) if each] == [7]
    assert flags[7][0].words.startswith("likeness of its picture to the others' is ")


def body(rng, x=1, y=1, z=1):
    """A body without symmetry, seen from above and from the side; -1 turns an axis over."""
    world = np.stack(np.meshgrid(*[np.arange(-20, 21)] * 3, indexing="ij"), axis=-1) + rng.normal(0, 0.7, 3)
    data = 100.0 * (np.abs(world) < [12, 17, 14]).all(axis=-1)
    for centre in ([8, 3, 0], [-2, 10, 4], [1, -3, 9]):
        data += 80.0 * (np.linalg.norm(world - centre, axis=-1) < 5 + rng.normal(0, 0.2))
    data = (data + rng.normal(0, 4, data.shape))[::x, ::y, ::z]
    image = Image(np.ascontiguousarray(data), np.eye(4))
    return thumbnail_png(image, lattice_mesh(image, blocks=(2, 2, 2)))


@pytest.mark.full
@pytest.mark.parametrize(
    ("turn", "words"), [({"x": -1}, "left and right"), ({"y": -1}, "back and front"), ({"z": -1}, "up and down")]
)
def test_a_subject_turned_over_is_flagged(tmp_path, turn, words):
    """Though its header says nothing of it."""
    rng = np.random.default_rng(5)
    for k in range(10):
        save_run(tmp_path, f"sub-{k}", run_of(rng), body(rng, **(turn if k == 4 else {})))
    flags = flags_of(collect(tmp_path))
    assert [flag.words for flag in flags[4]][:1] == [
        f"its picture is more like the others' with {words} exchanged; not so for 9 of 10"
    ]
    assert [k for k, each in enumerate(flags) if each] == [4]


def row_of(likeness, **margins):
    numbers = {f"thumbnail.{name}": value for name, value in {"likeness": likeness, **margins}.items()}
    return Row("sub-1", "sub-1", "", "done", "", (), {}, {"quality.ndim": 3, **numbers}, {}, {}, {})


def turned_of(rows):
    return [(k, flag.column) for k, each in enumerate(flags_of(rows)) for flag in each if "exchanged" in flag.words]


def test_another_organ_does_not_hide_what_is_turned_over():
    """Numbers of ten real heads, one turned over, and beside it one that is like nothing, turned over or not."""
    others = [row_of(0.98, back_front=-0.11 + 0.002 * k) for k in range(8)]
    turned, organ = row_of(0.88, back_front=0.104), row_of(0.22, back_front=0.0095)
    assert turned_of([*others, turned, organ]) == [(8, "thumbnail.back_front")]
    assert turned_of([*others[:6], turned, organ]) == [(6, "thumbnail.back_front")]
    assert turned_of([*others[:5], turned, organ]) == []  # of seven nothing is said


def test_the_sign_alone_is_no_turn():
    """Of what is symmetric, or about as like the others' either way."""
    others = [row_of(0.98, left_right=-0.0001 - 0.001 * k) for k in range(8)]
    assert turned_of([*others, row_of(0.98, left_right=0.0008)]) == []
    assert turned_of([*others, row_of(0.98, left_right=0.05)]) == []  # turned over it would be at 0.004
    sided = [row_of(0.98, left_right=-0.1 - 0.001 * k) for k in range(8)]
    many = [row_of(0.98, left_right=0.1 + 0.001 * k) for k in range(8)]
    assert turned_of([*sided, *many]) == []  # none is the odd one
    assert turned_of([*sided, row_of(0.98, left_right=0.02)]) == []  # a fifth of what it would be at: cut off
    assert turned_of([*sided, row_of(0.98, left_right=0.04)]) == [(8, "thumbnail.left_right")]
    little = [row_of(0.98, left_right=-0.008 - 1e-4 * k) for k in range(8)]
    assert turned_of([*little, row_of(0.98, left_right=0.0049)]) == []
    assert turned_of([*little, row_of(0.98, left_right=0.0051)]) == [(8, "thumbnail.left_right")]
    spread = [row_of(0.98, left_right=-0.15 + 0.03 * k) for k in range(8)]
    assert turned_of([*spread, row_of(0.98, left_right=0.04)]) == []
    steps = [0.0, 0.0, *[0.041, -0.041] * 4, *[0.06, -0.06] * 2]  # 1.4826 * 0.041 is a deviation: 2.5 end at 0.052
    wide = [row_of(0.98, left_right=-0.1 + step) for step in steps]
    assert turned_of([*wide, row_of(0.98, left_right=0.05)]) == []
    assert turned_of([*wide, row_of(0.98, left_right=0.054)]) == [(14, "thumbnail.left_right")]


def test_pictures_of_planes_have_no_up_and_down(tmp_path):
    flat = np.arange(128.0)[:, None] + np.arange(128) / 2
    one, other = saved(tmp_path / "a.png", flat), saved(tmp_path / "b.png", flat[::-1])
    third = likenesses([one, one, other])[2]
    assert third.back_front > 0.5 > 0.0 > third.left_right
    assert np.isnan(third.upside_down)
