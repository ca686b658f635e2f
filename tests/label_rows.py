"""Records of labels, from flat numbers."""

from tetopt.measure.fidelity import ROW_KEYS, LabelFidelity, LabelInterface


def label_row(label, **numbers):
    """A record with these numbers, by their keys in run.json; the others are not measured."""
    return with_numbers(LabelFidelity(label), **numbers)


def with_numbers(row, **numbers):
    """The record with other numbers."""
    groups = {}
    for name in ("extent", "pieces", "overlap", "distance", "thickness"):
        group = getattr(row, name)
        keys = {field: ROW_KEYS.get(field, field) for field in group._fields}
        own = {field: numbers.pop(key) for field, key in keys.items() if key in numbers}
        groups[name] = group._replace(**own)
    assert not numbers
    return row._replace(**groups)


def surface_of(label, **numbers):
    """A label's surface; all other numbers are 0."""
    return LabelInterface(**dict.fromkeys(LabelInterface._fields, 0) | numbers | {"label": label})
