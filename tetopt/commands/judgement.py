"""Measures of a mesh's file: its shape, the fit of its cells to an image, and the requirements
of its run.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from tetopt.commands.beside import check_part
from tetopt.contents.labels import LARGEST_LABEL
from tetopt.energy.discretization import content_E_D
from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError
from tetopt.geometry.check import check_mesh, manifold_problems, scaled_jacobians
from tetopt.geometry.simplex import dihedral_angles
from tetopt.job.advice import (
    Problem,
    order_problems,
    required_of,
    sentences,
    tell,
    unmet_requirements,
)
from tetopt.job.aligned import read_companion
from tetopt.job.events import warning
from tetopt.job.mesh_file import check_mesh_place, label_table, read_mesh, warn_of_other_image
from tetopt.job.options import WHOLE_IMAGE, ImagePart, MaskedPart, SourceOptions
from tetopt.job.request import checksum
from tetopt.job.source import Source, read_source
from tetopt.measure.fidelity import ImageFit, image_fit
from tetopt.measure.judge import Requirements, measure
from tetopt.measure.judge import judge as judge_rows
from tetopt.measure.measures import fidelity
from tetopt.measure.quality import Quality, quality
from tetopt.model.file import MASK_TEXT, MeshFile, words_of_other_box
from tetopt.model.label_names import LABEL_FIELD
from tetopt.model.sets import Names
from tetopt.report.summary import size_summary
from tetopt.system.arrays import Json


class Judgement(NamedTuple):
    """The measures of a mesh's file."""

    path: Path
    loaded: MeshFile
    shape: Quality
    numbers: Json  # all numbers, as `tetopt quality --json` writes them
    is_checked: bool
    source: Source | None = None  # the image, mask and labels it was measured on
    fit: ImageFit | None = None
    violated: Mapping[str, str] = MappingProxyType({})  # requirements of the run
    # fit to mask, labels and contrasts; never modified
    measured: Json = {}  # noqa: RUF012
    is_compared: bool = True  # with the mask; the mesh's file does not contain the fractions of one

    @property
    def is_masked(self) -> bool:
        """True if the mesh was built within a mask or without a background."""
        inputs = self.loaded.table("inputs")
        was_masked = any(
            inputs.get(name) is not None for name in ("mask", "background", "kept_labels")
        )
        is_masked = self.source is not None and self.source.mask is not None
        return was_masked or is_masked or MASK_TEXT in self.loaded.field_data

    @property
    def mask_word(self) -> str:
        """The name of the meshed region in messages, as in the run that built the mesh."""
        is_given = self.source is not None and self.source.about["inputs"]["mask"] is not None
        return (
            "mask"
            if is_given or self.loaded.table("inputs").get("background") is None
            else "foreground"
        )

    @property
    def is_filled(self) -> bool:
        """True if the mesh should fill the image's box: neither built within a mask, nor from
        another mesh, nor moved since.
        """
        was_started = self.loaded.table("options").get("start") is not None
        return not (self.is_masked or self.loaded.is_moved or was_started)

    @property
    def left_out(self) -> list[str]:
        """Inputs of the run that built the mesh which are missing here."""
        if self.source is None:
            return []
        inputs = self.loaded.table("inputs")
        there = {"mask": self.source.mask, "labels": self.source.labels}
        left_out = [
            name for name, image in there.items() if image is None and inputs.get(name) is not None
        ]
        left_out += ["tissues"] * (self.source.labels is None and inputs.get("tissues") is not None)
        images = inputs.get("images")
        return left_out + ["other images"] * (isinstance(images, list) and len(images) > 1)

    @property
    def required(self) -> Requirements:
        """Requirements of the run that built the mesh, from its file."""
        options = self.loaded.table("options")
        is_fast = options.get("method") == "fast"
        return required_of(self.mask_word, self.measured.get("label_names", {}))._replace(
            min_dihedral=_number(options.get("min_dihedral")) or 0.0 if is_fast else 0.0,
            target_error=None if self.left_out else _number(options.get("target_error")),
            is_initial=options.get("iterations") == 0,
        )

    def tell(self) -> list[str]:
        """Report the mesh's problems; return a line on each that makes it fail."""
        problems = self.problems()
        tell(problems)
        return [each.words for each in problems if each.name is not None]

    def problems(self) -> list[Problem]:
        """Return the mesh's problems, worst first; those with a name make it fail."""
        wrong: list[str] = self.numbers.get("problems", [])
        if wrong and not {"box", "cover", "manifold"}.isdisjoint(self.violated):
            # these sentences name the rest
            mesh = self.loaded.mesh
            is_whole = not self.is_masked
            wrong = check_mesh(mesh, is_whole=is_whole, is_manifold=False)
        is_named = self.fit is None or (self.is_checked and "overlap" in self.violated)
        overlap = None if is_named else cast(ImageFit, self.fit).overlap
        named = [("mesh", each) for each in wrong] + (
            [] if overlap is None else [("overlap", overlap)]
        )
        problems = [
            Problem(f"{self.path}: {each}", name=name, is_failure=True) for name, each in named
        ]
        requirements = self.violated
        measured = self.measured
        if not self.is_checked:  # only what makes the numbers meaningless
            requirements = {name: each for name, each in requirements.items() if name == "mask"}
            measured = {}
        problems += unmet_requirements(requirements, measured, self.required)
        if self.is_checked and self.source is None:
            problems += self._recorded(("min_dihedral", *(name for name, _ in named)))
        return order_problems(
            [
                *problems,
                *(Problem(f"{self.path}: {each}") for each in self.numbers.get("remarks", [])),
            ]
        )

    def _recorded(self, measured: Collection[str]) -> list[Problem]:
        """Return requirements that the mesh's run violated, by its file, beyond those `measured`
        here.
        """
        recorded = {
            name: words
            for name, words in self.loaded.table("violated").items()
            if name not in measured
        }
        return [
            Problem(f"{self.path}: when built, {words}", name=name)
            for name, words in recorded.items()
        ]


def judge(
    mesh: Path,
    image: Path | None = None,
    labels: Path | None = None,
    *,
    part: MaskedPart = WHOLE_IMAGE,
    label_names: Path | None = None,
    check: bool = False,
) -> Judgement:
    """Measure a mesh's file: its shape and, given an image, mask and labels, the fit of its cells.

    With `check`, also check that it is a valid mesh and, given an image, that it meets its run's
    requirements.

    Raises
    ------
    InputError
        Files cannot be read, or the files that they belong to are missing; the image has a
        different box than that of the mesh's run, unless it is registered and `check` is not
        requested.
    """
    check_part(image, part)
    if image is None and labels is not None:
        raise InputError("`labels`: needs `image`, on whose voxels they are compared")
    if label_names is not None and labels is None and part.mask_label is None:
        raise InputError("`label_names`: needs `labels` or `mask_label`")
    loaded = read_mesh(mesh, part)
    shape = quality(loaded.mesh.points, loaded.mesh.cells, loaded.mesh.midpoints)
    size = size_summary(loaded.mesh, loaded.order)
    numbers = {"mesh": mesh.name, "size": size, "quality": shape, "n_turned": loaded.n_turned}
    if loaded.mesh.midpoints is not None:
        numbers["min_scaled_jacobian"] = float(scaled_jacobians(loaded.mesh).min())
    judgement = Judgement(mesh, loaded, shape, numbers, check)
    if image is not None:
        source = _source(loaded, image, labels, part, label_names)
        first = source.contrasts[0]
        is_registered = part.registered
        check_mesh_place(mesh, loaded.mesh, first)
        is_other = warn_of_other_image(
            loaded, mesh, image, first, is_registered=is_registered, is_exact=check
        )
        if not is_other and (words := words_of_other_box(loaded, first)):
            warning(
                f"{image}: the mesh is of another box of it, {words}; pass the run's `crop`, as "
                "measures depend on it"
            )
        has_mask = part.mask is not None or loaded.table("inputs").get("background") is not None
        judgement = judgement._replace(source=source, is_compared=has_mask)
        judgement = _measure_fit(judgement, label_table(label_names, loaded, labels).names)
        numbers |= {**judgement.measured, "image": image.name, "fit": judgement.fit}
    elif check and loaded.mesh.ndim == 3:
        rows = {"min_dihedral": dihedral_angles(loaded.mesh.points, loaded.mesh.cells).min(axis=1)}
        judgement = judgement._replace(violated=judge_rows(rows, judgement.required))
    if check:
        problems, remarks = _mesh_problems(judgement)
        numbers |= {"problems": problems, "remarks": remarks}
    if check or image is not None:
        numbers["violated"] = sentences(judgement.problems())
    return judgement


def _source(
    loaded: MeshFile, image: Path, labels: Path | None, part: MaskedPart, names: Path | None
) -> Source:
    """Read the files that the mesh is measured on, with the weights stated in the mesh's file."""
    inputs = loaded.table("inputs")
    weight = _number(inputs.get("label_weight"))
    weights = inputs.get("weights")
    filled = inputs.get("filled_holes")
    own = _number(weights[0]) if isinstance(weights, list) and len(weights) == 1 else None
    options = SourceOptions(
        images=[image],
        labels=labels,
        mask=part.mask,
        mask_label=part.mask_label,
        **{name: getattr(part, name) for name in vars(ImagePart())},
        weights=None if labels is None or own is None else repr(own),
        label_weight=None if labels is None else weight,
        smooth_interfaces=labels is None or inputs.get("smooth_interfaces") != 0,
        keep_components=False,
        fill_holes=None if labels is None or not isinstance(filled, int) else str(filled),
    )
    # the file's mask is that of all labels
    if labels is None and inputs.get("kept_labels") is not None:
        loaded = loaded._replace(
            field_data={
                name: text
                for name, text in loaded.field_data.items()
                if name not in (MASK_TEXT, "inputs")
            }
        )
    names = None if part.mask_label is None else names
    kept = inputs.get("kept_labels")
    kept = [each for each in kept if isinstance(each, int)] if isinstance(kept, list) else []
    numbers = None if labels is None else _merged_numbers(inputs, labels, part)
    return read_source(
        options,
        names,
        numbers=numbers,
        loaded=loaded,
        kept=None if labels is None else kept or None,
    )


def _merged_numbers(inputs: Mapping[str, Any], labels: Path, part: ImagePart) -> dict[int, int]:
    """Return the numbers that the mesh's run gave to merged labels; none if the labels have them
    already.
    """
    table = inputs.get("merged")
    sums = inputs.get("sha256")
    numbers = {
        int(old): new
        for old, new in (table.items() if isinstance(table, dict) else ())
        if old.isdecimal() and isinstance(new, int) and 0 <= new <= LARGEST_LABEL >= int(old)
    }
    if not numbers or (isinstance(sums, dict) and sums.get(labels.name) == checksum(labels)):
        return numbers
    return (
        {}
        if np.isin(read_companion(labels, part.spacing_mm).data, list(numbers.values())).all()
        else numbers
    )


def _measure_fit(judgement: Judgement, names: Names) -> Judgement:
    """Measure the fit of the cells to the image, mask and labels, and judge it."""
    source = cast(Source, judgement.source)
    loaded = judgement.loaded
    mesh = loaded.mesh
    of_cell = loaded.cell_data.get(LABEL_FIELD)
    fit = image_fit(source.contrasts[0], mesh)
    measured = fidelity(source.labels, source.mask, mesh, of_cell, what=source.content)
    labels = [row.label for row in measured.get("labels", [])]
    if own_names := {label: names[label] for label in labels if label in names}:
        measured["label_names"] = own_names
    counted = content_E_D(source.content, mesh)
    if counted[1] == 0:
        raise InputError(
            f"{judgement.path}: the mesh lies outside the mask and its surroundings; was it "
            "built within another mask?"
        )
    is_uniform = source.content.variance == 0.0
    known = {"labels": measured["labels"]} if "labels" in measured else {}
    known |= {"mask": measured["mask"].dice} if "mask" in measured else {}
    # another program's mesh has no method
    is_filled = judgement.is_filled and "method" in loaded.table("options")
    rows = measure(mesh, source.content, of_cell, is_filled=is_filled, counted=counted, known=known)
    fit = fit._replace(
        E_D=counted[0], E_D_fraction_of_variance=None if is_uniform else rows["error"]
    )
    if not judgement.is_compared:
        measured.pop("mask", None)
    if not source.content.is_plain:
        measured["contrasts"] = source.by_contrast(cell_moments(source.image, mesh)._asdict())
    judgement = judgement._replace(fit=fit, measured=measured)
    # the run's requirements were those of the nodes' former place
    violated = {} if loaded.is_moved else judge_rows(rows, judgement.required)
    return judgement._replace(violated=violated)


def _number(value: Any) -> float | None:
    """Return a number from a mesh's file; None for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _mesh_problems(judgement: Judgement) -> tuple[list[str], list[str]]:
    """Return the problems of a mesh; without any, remarks that are no faults.

    Non-manifold interfaces of labels are remarks, but problems of a run that smoothed interfaces.
    """
    mesh = judgement.loaded.mesh
    image = None if judgement.source is None else judgement.source.contrasts[0]
    problems = check_mesh(
        mesh, image, is_whole=not judgement.is_masked, is_filled=judgement.is_filled
    )
    labels = judgement.loaded.cell_data.get(LABEL_FIELD)
    touching = []
    if problems or labels is None:
        return problems, []
    if labels.ndim == 1 and ((np.rint(labels) == labels) & (labels >= 0)).all():
        touching = manifold_problems(mesh, labels)
    is_smooth = judgement.loaded.table("inputs").get("smooth_interfaces")
    return (touching, []) if is_smooth else ([], touching)
