"""The inputs of a mesh: contrasts, labels and mask, on the voxels of the first image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.contents.align import (
    KEEP_PIECES,
    background_level,
    fill_holes,
    foreground,
    resample_contrast,
    resample_labels,
)
from tetopt.contents.content import Content, content, continue_image
from tetopt.contents.domain import INSIDE_FRACTION, mask_text
from tetopt.contents.labels import BACKGROUND_LABEL, LARGEST_LABEL
from tetopt.contents.probabilities import resample_tissue, tissue_labels
from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError, prefix_errors
from tetopt.image import Image
from tetopt.io.label_tables import NO_TABLE, LabelTable
from tetopt.io.text import count_text, list_names
from tetopt.job.advice import required_of
from tetopt.job.aligned import (
    Align,
    Beside,
    Originals,
    image_and_others,
    mask_for,
    read_companion,
    read_image,
    read_mask,
)
from tetopt.job.events import note, warning
from tetopt.job.mesh_file import label_table
from tetopt.job.option_values import (
    Balance,
    balance_of,
    file_and_volume,
    number_of,
    tissue_files,
    tissue_volumes,
)
from tetopt.job.options import SourceOptions
from tetopt.job.request import checksum
from tetopt.measure.fidelity import cell_labels, unexplained_of
from tetopt.measure.judge import Requirements
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields
from tetopt.model.file import MASK_TEXT, MeshFile
from tetopt.model.label_names import (
    LABEL_FIELD,
    TABLE_TEXT,
    kept_labels,
    label_words,
    labels_named,
    table_of_labels,
    table_words,
)
from tetopt.model.sets import box_of, box_text
from tetopt.model.tissues import is_preset, merge_labels, numbers_by_name, renumber_labels
from tetopt.system.arrays import Arrays, Ints, Json

AUTO_BACKGROUND = "use `background` auto"
# of a foreground, from which its part that is no brighter than the background's noise is reported
NOISE_SHARE = 0.25


class Source(NamedTuple):
    """The content to mesh, and its files."""

    paths: list[Path]  # of the contrasts
    weights: list[float]  # of the contrasts
    content: Content
    contrasts: list[Image]  # on the first one's voxels
    labels: Image | None  # on the same voxels
    mask: Image | None
    about: Json  # names, checksums, weights and the image's box, for the mesh's file
    table: LabelTable  # of the labels
    remedy: str = ""  # if noise is what gives the region more detail than cells

    @property
    def image(self) -> Image:
        """The first contrast on its own voxels, continued beyond the mask, around which alone
        voxels are kept.
        """
        return continue_image(self.contrasts[0], self.content.continuation)

    @property
    def mask_word(self) -> str:
        """The name of the meshed region in messages."""
        return "mask" if self.about["inputs"]["background"] is None else "foreground"

    @property
    def required(self) -> Requirements:
        """Words for the verdict on its mesh."""
        return required_of(self.mask_word, self.table.names, self.remedy)

    @property
    def surface_words(self) -> str:
        """Name the surfaces that nodes follow; empty if there are none."""
        of_mask = "" if self.mask is None else f"the surface of the {self.mask_word}"
        return of_mask if self.labels is None else "the interfaces of labels"

    @property
    def low(self) -> float:
        """The least intensity."""
        return self.content.spread.low

    @property
    def is_constant(self) -> bool:
        """True if the content has one value everywhere."""
        spread = self.content.spread
        return spread.low == spread.high

    def fields(self, mesh: Mesh, labels: Ints | None = None) -> Arrays:
        """Return the fields of the mesh's file: those of `cell_fields`, means of further contrasts,
        and the label.

        `labels` (M,) are those of the optimisation; without them, a cell has the majority label of
        its voxels.
        """
        fields = cell_fields(mesh, self.image)
        for number, contrast in enumerate(self.contrasts[1:], 2):
            moments = cell_moments(continue_image(contrast, self.content.continuation), mesh)
            fields |= {f"mean_{number}": moments.mean, f"variance_{number}": moments.variance}
        if labels is not None:
            fields[LABEL_FIELD] = labels
        elif self.labels is not None:
            fields[LABEL_FIELD] = cell_labels(
                continue_image(self.labels, self.content.continuation), mesh
            )
        return fields

    def with_table(self, table: LabelTable) -> Source:
        """Return the source with other names and colours of labels."""
        words = {TABLE_TEXT: table_words(table)} if table.names or table.colours else {}
        return self._replace(table=table, about=self.about | words)

    def by_contrast(self, fields: Arrays) -> list[Json]:
        """Return, for each contrast, the fraction of its variance that is left within cells with
        these fields.
        """
        rows = []
        for number, (path, weight) in enumerate(zip(self.paths, self.weights, strict=True), 1):
            mean, variance = (
                fields[field if number == 1 else f"{field}_{number}"]
                for field in ("mean", "variance")
            )
            fraction = unexplained_of(fields["n_voxels"], mean, variance)
            rows.append(
                {"image": path.name, "weight": weight, "E_D_fraction_of_variance": fraction}
            )
        return rows


def read_source(
    options: SourceOptions,
    label_names: Path | None = None,
    numbers: Mapping[int, int] | None = None,
    loaded: MeshFile | None = None,
    kept: Sequence[int] | None = None,
) -> Source:
    """Read images, labels with their names, and mask, on the voxels of the first image.

    Labels get other `numbers` if given; otherwise they are merged by the options and their names.
    Only the labels in `kept` stay, if given; otherwise the options choose. Without a mask or a
    background in the options, that of a mesh's file counts, if one was `loaded`.
    """
    paths = options.images
    finest: Originals = read_mask(options, label_names)
    if options.labels is not None:
        key = (options.labels, _align_of_labels(options, numbers))
        finest = {**finest, key: read_companion(options.labels, options.spacing_mm)}
    image, beside, factors = image_and_others(
        read_image(paths[0], options), paths[0], options, finest
    )
    labels, table, numbers, is_own = _labelling(options, image, beside, label_names, numbers)
    labels, filled = _without_holes(options, labels, table)
    if (
        labels is not None
        and is_own
        and (numbers or image.has_gaps or (filled is not None and options.tissues is None))
    ):
        image = labels
    contrasts = [image, *(beside(path, resample_contrast) for path in paths[1:])]
    mask, level, remedy = _region(options, image, labels, beside, loaded)
    labels, mask, kept = _choose_labels(options, labels, mask, table, kept)
    del finest, beside  # the files as read: their memory is needed
    balance = _balance(options, is_own)
    combined = content(
        contrasts,
        labels,
        mask,
        **balance._asdict(),
        smooth_interfaces=options.smooth_interfaces,
        keep_components=options.keep_components,
        keep_volumes=not options.free_volumes,
    )
    if max(factors) > 1:
        combined = combined._replace(repeats=factors)
    extras = {
        "smooth_interfaces": None if labels is None else options.smooth_interfaces,
        "free_volumes": options.free_volumes or None,
        "merged": {str(old): new for old, new in numbers.items()} if numbers else None,
        "mask_label": options.mask_label,
        "divided": factors if max(factors) > 1 else None,
        "keep_components": None if mask is None else options.keep_components,
        "kept_labels": kept,
        "filled_holes": filled,
    }
    inputs = _inputs(options, balance.weights, level, extras)
    about = {
        "image": paths[0].name,
        "image_sha256": checksum(paths[0]),
        "inputs": inputs,
        "box": box_text(box_of(image)),
        **({} if mask is None else {MASK_TEXT: mask_text(mask)}),
    }
    return Source(
        paths, balance.weights, combined, contrasts, labels, mask, about, NO_TABLE, remedy
    ).with_table(table)


def _balance(options: SourceOptions, is_own: bool) -> Balance:
    """Return the requested balance; an image that is its own labels has no weight by default."""
    balance = balance_of(options)
    if options.weights is not None or not is_own:
        return balance
    whose = "one of the tissues"
    used = "tissues"
    if options.tissues is None:
        whose = "the label image"
        used = "labels"
    note(f"the image is also {whose}: only the {used} are used")
    return balance._replace(weights=[0.0])


def _region(
    options: SourceOptions,
    image: Image,
    labels: Image | None,
    beside: Beside,
    loaded: MeshFile | None,
) -> tuple[Image | None, float | None, str]:
    """Return the mask, the background's level if the options remove one, and the remedy if that
    leaves noise.
    """
    if options.background is None:
        return mask_for(options, image, beside, loaded), None, ""
    is_auto = options.background == "auto"
    level = background_level(image) if is_auto else number_of("`background`", options.background)
    front = _foreground(image, level, labels)
    noise = "" if is_auto else _words_on_noise(image, level, front)
    if noise:
        warning(f"background: {noise}; {AUTO_BACKGROUND}")
    return front, level, AUTO_BACKGROUND if noise else ""


def _words_on_noise(image: Image, level: float, front: Image) -> str:
    """Describe a foreground above a level that keeps the background's noise; empty if it keeps
    little.
    """
    try:
        highest = background_level(image)
    except InputError:
        return ""  # no background is found
    is_dark = (front.data > 0.0) & (image.data <= highest)
    share = is_dark.sum() / front.data.sum()
    if highest <= level or share < NOISE_SHARE:
        return ""
    return (
        f"{share:.0%} of what stays above {level:g} is no brighter than the noise ({highest:.4g})"
    )


def _inputs(
    options: SourceOptions, weights: list[float], level: float | None, extras: Json
) -> Json:
    """Return what a mesh's file states of its inputs; of the optional ones, those not None."""
    tissues = [file_and_volume(path)[0] for path in tissue_files(options.tissues)]
    others = [path for path in (options.mask, options.labels, *tissues) if path is not None]
    optional = {"tissues": [path.name for path in tissues] or None, **extras}
    return {
        "images": [path.name for path in options.images],
        "weights": weights,
        "mask": None if options.mask is None else options.mask.name,
        "background": level,
        "labels": None if options.labels is None else options.labels.name,
        "label_weight": options.label_weight,
        **{name: each for name, each in optional.items() if each is not None},
        "sha256": {path.name: checksum(path) for path in (*options.images[1:], *others)},
    }


def _without_holes(
    options: SourceOptions, labels: Image | None, table: LabelTable
) -> tuple[Image | None, int | None]:
    """Return the labels, and the label that enclosed voxels of label 0 have got, if any; report
    these.
    """
    if options.fill_holes is None:
        return labels, None
    assert labels is not None, "the plan requires labels"
    label = _label_of_holes(options.fill_holes, table)
    filled, sizes, around = fill_holes(labels, label)
    if len(sizes):
        volumes = sizes * float(np.prod(labels.spacing))
        by_label = sorted(
            ((float(volumes[around == each].sum()), each) for each in np.unique(around)),
            reverse=True,
        )
        words = (
            f"{count_text(len(sizes), 'hole')} of {volumes.sum():.4g} mm{labels.ndim}, the "
            f"largest {volumes.max():.4g}"
        )
        note(f"label 0: {words}, filled by {label_words(label, table.names)}")
        parts = [
            f"{label_words(each, table.names)} {size:.4g} mm{labels.ndim}"
            for size, each in by_label
        ]
        note(f"labels around most of each hole: {list_names(parts)}")
    else:
        warning(
            "`fill_holes`: no voxel of label 0 is enclosed: all are connected by faces to the "
            "box's sides"
        )
    return filled, label if len(sizes) else None


def _label_of_holes(text: str, table: LabelTable) -> int:
    """Parse the label that holes get."""
    with prefix_errors("`fill_holes`"):
        (label, *others) = labels_named(text, table.names)
    if others or not BACKGROUND_LABEL < label <= LARGEST_LABEL:
        raise InputError(
            f'`fill_holes`: expected one label from 1 to {LARGEST_LABEL}, got "{text}"'
        )
    return label


def _choose_labels(
    options: SourceOptions,
    labels: Image | None,
    mask: Image | None,
    table: LabelTable,
    kept: Sequence[int] | None,
) -> tuple[Image | None, Image | None, Sequence[int] | None]:
    """Return the labels that stay and the mask of their voxels, within another mask; and their
    numbers, if chosen.
    """
    if kept is None and options.keep_labels is None and options.drop_labels is None:
        return labels, mask, None
    assert labels is not None, "the plan requires labels"
    if kept is None:
        present = np.unique(labels.data).astype(np.int64).tolist()
        kept = kept_labels(options.keep_labels, options.drop_labels, present, table.names)
    is_kept = np.isin(labels.data, kept)
    if not (is_kept if mask is None else is_kept & (mask.data >= INSIDE_FRACTION)).any():
        raise InputError(
            f"labels that stay, {list_names(kept)}: no voxel within the mask has one of them"
        )
    mask = Image(is_kept if mask is None else np.where(is_kept, mask.data, 0.0), labels.affine)
    # Those left out on purpose are not reported as missing.
    return Image(np.where(is_kept, labels.data, BACKGROUND_LABEL), labels.affine), mask, kept


def _foreground(image: Image, level: float, labels: Image | None) -> Image:
    """Return the mask of the foreground; report what is left out, and what stays."""
    front = foreground(image, level, labels)
    remain = f"{front.mask.data.mean():.1%} of voxels remain"
    note(f"background: voxels up to {level:g} connected to the box's sides are removed; {remain}")
    if front.words:
        (warning if front.is_suspect else note)(f"background: {front.words} ({KEEP_PIECES})")
    return front.mask


class ReadLabels(NamedTuple):
    """Labels of the image's voxels, as read."""

    labels: Image | None = None
    table: LabelTable = NO_TABLE
    numbers: Mapping[int, int] = {}
    is_own: bool = False  # whether the image contains nothing else


def _labelling(
    options: SourceOptions,
    image: Image,
    beside: Beside,
    label_names: Path | None,
    numbers: Mapping[int, int] | None,
) -> ReadLabels:
    """Read the labels, merged by the options, or the tissues."""
    table = label_table(label_names, labels_path=options.labels)
    is_alone = len(options.images) == 1
    if options.tissues is not None:
        volumes = tissue_volumes(options.tissues)
        tissues = [beside(path, resample_tissue) for path in volumes.values()]
        if not table.names:
            table = LabelTable(dict(enumerate(volumes, 1)), table.colours)
        is_own = is_alone and options.images[0] in tissue_files(options.tissues)
        return ReadLabels(tissue_labels(tissues), table, {}, is_own)
    if options.labels is None:
        return ReadLabels(table=table)
    labels = beside(options.labels, _align_of_labels(options, numbers))
    own = image.with_zeros()
    is_own = is_alone and np.array_equal(labels.data, own.data)
    labels = own if is_own else labels  # kept once
    return ReadLabels(*_merge_labels(labels, table, options, numbers), is_own=is_own)


def _align_of_labels(options: SourceOptions, numbers: Mapping[int, int] | None) -> Align:
    """Return how to resample labels: if some may be left out on purpose, without a warning of
    those outside.
    """
    return _some_labels if options.merge or options.crop or numbers else resample_labels


def _some_labels(labels: Image, image: Image, name: str) -> Image:
    return resample_labels(labels, image, name, may_miss=True)


def _merge_labels(
    labels: Image, table: LabelTable, options: SourceOptions, numbers: Mapping[int, int] | None
) -> tuple[Image, LabelTable, Mapping[int, int]]:
    """Merge labels by the options, or by shared names; return them, their table, and their new
    numbers.
    """
    if numbers is not None:
        return renumber_labels(labels, numbers), table, numbers
    if options.merge is not None:
        with prefix_errors(options.labels):
            merged = merge_labels(labels, options.merge, table.names)
        missing = [
            name for label, name in merged.names.items() if label not in merged.numbers.values()
        ]
        if missing and not is_preset(options.merge):
            warning(f"`merge`: {options.labels} has no label for {list_names(missing)}")
        sizes = sorted(Counter(merged.numbers.values()).items())
        parts = [
            f"{count_text(n, 'label')} into {label_words(new, merged.names)}" for new, n in sizes
        ]
        note(f"merged: {list_names(parts)}")
        return merged.labels, LabelTable(merged.names, {}), merged.numbers
    present = np.unique(labels.data)
    numbers = {old: new for old, new in numbers_by_name(table.names).items() if old in present}
    if not numbers:
        return labels, table, numbers
    words = [f"{old} into {label_words(new, table.names)}" for old, new in sorted(numbers.items())]
    note(f"merged labels with the same name: {list_names(words)}")
    left = set(table.names) - set(numbers_by_name(table.names))
    return renumber_labels(labels, numbers), table_of_labels(table, left), numbers


def whose_variance(content: Content) -> str:
    """Name the variance that E_D is a fraction of; labels that are their own image are the only
    channels.
    """
    if content.n_contrasts == 1 and content.n_channels == 1:
        return "the image's variance"
    return (
        "the labels' variance"
        if content.n_contrasts == 0
        else "the variance of all images and labels"
    )
