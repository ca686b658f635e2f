"""The house rules: what a reader of any one file may rely on in all of them."""

import ast
import importlib
import io
import re
import tokenize
import tomllib
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    path for path in (ROOT / "tetopt").rglob("*.py") if "__pycache__" not in path.parts
)
DOCUMENTS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("**/*.md")),
    ROOT / "benchmarks" / "README.md",
]
# More than 8 parameters: public functions, whose signature is a contract.
WIDE = {
    "tetopt.cli.convert.convert_command": 9,
    "tetopt.engine.fast.__init__": 9,
    "tetopt.fem.elasticity.compression": 9,
    "tetopt.engine.fast.optimize": 15,
    "tetopt.engine.meshing.mesh_image": 15,
    "tetopt.engine.paper.optimize_paper": 12,
    "tetopt.fem.elasticity.constrain_nodes": 9,
    "tetopt.model.build.build_model": 19,
    "tetopt.report.figures.save_run_figures": 9,
}
# Verbs that once stood for a dozen things each; a variable is a noun, see docs/glossary.md.
VERBS = {"held", "wanted", "found", "given", "told", "asked"}

KERNELS = {"helper", "entry", "unit", "njit"}  # decorators of compiled functions
NOUNS = {"seed", "need", "speed", "feed"}  # that end like participles


@cache
def text_of(path):
    return path.read_text(encoding="utf-8")


@cache
def tree_of(path):
    return ast.parse(text_of(path))


@cache
def nodes_of(path):
    return list(ast.walk(tree_of(path)))


@cache
def tokens_of(path):
    return list(tokenize.generate_tokens(io.StringIO(text_of(path)).readline))


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def constants(paths=SOURCES):
    """Each assignment to a module's constant, alone or in a tuple: path, line, name, value."""
    for path in paths:
        for node in tree_of(path).body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                pairs = []
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    is_many = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                    pairs += (
                        zip(target.elts, node.value.elts, strict=True)
                        if is_many
                        else [(target, node.value)]
                    )
                for target, value in pairs:
                    if isinstance(target, ast.Name) and re.fullmatch(
                        r"_?[A-Z][A-Z0-9_]*", target.id
                    ):
                        yield path, node.lineno, target.id, value


def is_numeric(value):
    """A number, or a tuple, list or table of numbers, with whatever arithmetic."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return is_numeric(value.operand)
    if isinstance(value, ast.BinOp):
        return is_numeric(value.left) and is_numeric(value.right)
    if isinstance(value, ast.Call):
        return bool(value.args) and all(is_numeric(argument) for argument in value.args)
    if isinstance(value, ast.Tuple | ast.List):
        return all(is_numeric(item) for item in value.elts)
    return isinstance(value, ast.Dict) and all(
        is_numeric(item) for item in (*value.keys, *value.values)
    )


@cache
def comment_lines(path):
    """Lines with a comment of words, and those of them that hold nothing else."""
    comments = [
        t
        for t in tokens_of(path)
        if t.type == tokenize.COMMENT and not re.match(r"# *(noqa|type:|fmt:)", t.string)
    ]
    return {t.start[0] for t in comments}, {
        t.start[0] for t in comments if t.line.lstrip().startswith("#")
    }


@cache
def functions():
    """Every function: its name, its node, the number of its parameters and of its lines of code."""
    quiet = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    }
    rows = []
    for path in SOURCES:
        lines = set()
        for token in tokens_of(path):
            if token.type not in quiet:
                lines.update(range(token.start[0], token.end[0] + 1))
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                own = {line for line in lines if node.lineno <= line <= node.end_lineno}
                first = node.body[0]
                if ast.get_docstring(node) is not None:
                    own -= set(range(first.lineno, first.end_lineno + 1))
                count = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs)
                count += (node.args.vararg is not None) + (node.args.kwarg is not None)
                rows.append((f"{module_name(path)}.{node.name}", count, len(own)))
    return rows


def bare_kernel_numbers(path):
    """Decimal numbers inside kernels without a comment beside or above, but for those to 16 in
    steps of an eighth.
    """
    beside, alone = comment_lines(path)
    for function in nodes_of(path):
        if not isinstance(function, ast.FunctionDef) or not any(
            isinstance(word, ast.Name | ast.Attribute)
            and getattr(word, "id", getattr(word, "attr", None)) in KERNELS
            for decorator in function.decorator_list
            for word in ast.walk(decorator)
        ):
            continue
        for node in ast.walk(function):
            number = node.value if isinstance(node, ast.Constant) else None
            if type(number) is not float or (number * 8 % 1 == 0 and number <= 16):
                continue
            if node.lineno not in beside and node.lineno - 1 not in alone:
                yield f"{module_name(path)}:{node.lineno} {number}"


def participles(path):
    """Functions of a module that are called by a participle alone."""
    for node in tree_of(path).body:
        if isinstance(node, ast.FunctionDef):
            name = node.name.strip("_")
            if name not in NOUNS and re.fullmatch(r"[a-z]+ed|told|kept|seen|grown|slid", name):
                yield f"{module_name(path)}.{node.name}"


def label_literals(path):
    """Places that name the labels in a file's data by a text instead of `LABEL_FIELD`."""
    for node in nodes_of(path):
        of, key = None, None
        if isinstance(node, ast.Subscript):
            of, key = node.value, node.slice
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args:
            of, key = node.func.value, node.args[0]
        if getattr(of, "attr", None) == "cell_data" and getattr(key, "value", None) == "label":
            yield f"{module_name(path)}:{node.lineno}"


@pytest.mark.parametrize("law", [bare_kernel_numbers, participles, label_literals])
def test_laws_of_names_and_numbers(law):
    assert [place for path in SOURCES for place in law(path)] == []


@pytest.mark.parametrize(
    ("law", "bad", "good"),
    [
        (
            bare_kernel_numbers,
            "@helper\ndef f(x):\n    return x + 1e-9\n",
            "@helper\ndef f(x):\n    # mm, chosen\n    return 0.5 * x + 1e-9\n",
        ),
        (participles, "def _checked(x):\n    pass\n", "def check_mesh(x):\n    pass\n"),
        (
            label_literals,
            'of_cell = file.cell_data["label"]\n',
            "of_cell = file.cell_data[LABEL_FIELD]\n",
        ),
        (
            lambda path: [name for *_, name, _ in constants([path])],
            "FLAT_SIZE, FAR_SIZE = 1, 2\n",
            "flat, far = 1, 2\n",
        ),
    ],
    ids=["kernel numbers", "participles", "labels", "constants in tuples"],
)
def test_laws_see_what_breaks_them(law, bad, good, monkeypatch):
    for text, is_bad in [(bad, True), (good, False)]:
        path = ROOT / f"tetopt/{'bad' if is_bad else 'good'}_{abs(hash(text))}.py"
        monkeypatch.setitem(globals(), "text_of", lambda _, text=text: text)
        assert bool(list(law(path))) == is_bad


def test_modules_have_names_of_their_own():
    """But for options and texts of rooms, and commands, which are named as what they run."""
    names = Counter(
        path.stem
        for path in SOURCES
        if path.stem not in ("__init__", "options") and "cli" not in path.parts
    )
    assert {name: count for name, count in names.items() if count > 1} == {}


def test_the_layout_has_no_exceptions():
    files = [
        path
        for top in ("tetopt", "tests", "scripts", "docs", "benchmarks")
        for path in (ROOT / top).rglob("*.py")
    ]
    assert [path.name for path in files if re.search(r"# *fmt: *(skip|off)", text_of(path))] == []


def test_a_constant_has_one_meaning():
    """No name of a constant stands for two values, nor for one value in two places."""
    places = {}
    for path, line, name, _ in constants():
        places.setdefault(name, []).append(f"{module_name(path)}:{line}")
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_a_number_has_two_words_and_its_reason():
    """A numeric constant says in its name what it is of, and in a comment beside or above it why
    it is that.
    """
    one_word, bare = [], []
    for path, line, name, value in constants():
        if is_numeric(value):
            if "_" not in name.strip("_"):
                one_word.append(f"{module_name(path)}.{name}")
            beside, alone = comment_lines(path)
            # under one comment
            is_grouped = re.match(r"_?[A-Z]", text_of(path).splitlines()[line - 2]) is not None
            above = line - 2 if is_grouped else line - 1
            if not beside & set(range(line, value.end_lineno + 1)) and above not in alone:
                bare.append(f"{module_name(path)}.{name}")
    assert one_word == []
    assert bare == []


def exists(name):
    """Whether a dotted name is a module, or an attribute of one, however deep."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        for part in parts[count:]:
            fields = getattr(thing, "__annotations__", {})
            if not hasattr(thing, part):
                return part in fields and part == parts[-1]
            thing = getattr(thing, part)
        return True
    return False


@pytest.mark.full
def test_what_is_named_exists():
    """Every `tetopt.x.y` of a docstring, comment or document; and every file of the package that
    one names.
    """
    missing = {}
    for path in [*SOURCES, *DOCUMENTS]:
        names = set(re.findall(r"\btetopt(?:\.[A-Za-z_]\w*)+", text_of(path)))
        files = {
            name
            for name in names
            if re.search(r"\.(vtu|toml|scn|nii|inp|feb|py|md|json|html)$", name)
        }
        named = re.findall(
            r"`((?:tetopt|tests|benchmarks|docs|scripts|phantoms)/[\w./]+)`", text_of(path)
        )
        absent = {
            name
            for name in named
            if not (ROOT / name).exists() and not name.startswith("docs/_build")
        }
        absent |= {name for name in names - files if not exists(name)}
        missing |= {path.name: absent} if absent else {}
    assert missing == {}


def test_variables_are_nouns():
    """No variable, parameter or field is called by one of `VERBS` alone."""
    verbs = []
    for path in SOURCES:
        for node in nodes_of(path):
            name = getattr(node, "id", None) or getattr(node, "arg", None)
            if isinstance(node, ast.Name | ast.arg) and name in VERBS:
                verbs.append(f"{module_name(path)}:{node.lineno} {name}")
    assert verbs == []


def test_few_functions_have_many_parameters():
    """More than 8 parameters are named in `WIDE`, each; but for `build_model`, with 19, none has
    more than 15.
    """
    many = {name: count for name, count, _ in functions() if count > 8}
    assert many == WIDE
    assert len(WIDE) <= 9
    assert many.pop("tetopt.model.build.build_model") <= 19
    assert max(many.values()) <= 15


def test_no_circle_of_imports():
    """Not even through imports inside functions."""
    modules = {module_name(path): path for path in SOURCES}
    edges = {}
    for name, path in modules.items():
        found = set()
        for node in nodes_of(path):
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{name}:{node.lineno}: imports by their whole names"
                submodules = {f"{node.module}.{alias.name}" for alias in node.names}
                found.update(submodules & set(modules) or {node.module})
        edges[name] = {target for target in found if target in modules and target != "tetopt"}
    TopologicalSorter(edges).prepare()  # CycleError, with the circle


def test_every_room_is_on_the_page_and_in_the_picture():
    rooms = {path.parent.name for path in (ROOT / "tetopt").glob("*/__init__.py")}
    page, picture = (
        text_of(ROOT / "docs" / "architecture.md"),
        text_of(ROOT / "docs" / "architecture.svg"),
    )
    assert {room for room in rooms if f"`{room}/`" not in page} == set()
    assert {room for room in rooms if f">{room}/<" not in picture} == set()


def test_every_public_module_is_on_the_page():
    """Each module of a room is named in its line of the page."""
    page = text_of(ROOT / "docs" / "architecture.md")
    rows = dict(re.findall(r"^\| (`[^|]*) \| (.*) \|$", page, re.M))
    of_room = {room: row for rooms, row in rows.items() for room in re.findall(r"`(\w+)/?`", rooms)}
    missing = []
    for path in SOURCES:
        parts = path.relative_to(ROOT / "tetopt").with_suffix("").parts
        if len(parts) == 2 and not parts[1].startswith("__"):
            words = set(re.findall(r"`(\w+)`", of_room.get(parts[0], "")))
            if parts[1] not in words:
                missing.append("/".join(parts))
    assert missing == []


def test_only_the_command_names_options():
    """Messages of the library name arguments, between backticks, which `tetopt.cli` turns into
    options.
    """
    others = {"tetopt.workers"}  # says how to start programs
    option = re.compile(r"(?<!\S)[`(]?--[a-z]")
    named = [
        f"{module_name(path)}:{node.lineno} {node.value[:60]!r}"
        for path in SOURCES
        if "cli" not in path.parts and path.name != "bids.py" and module_name(path) not in others
        for node in nodes_of(path)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if option.search(re.sub(r"(tetopt|cgal_mesh) [^:`]*", "", node.value))  # whole commands
    ]
    assert named == []


def test_a_class_name_has_one_meaning():
    names = Counter(
        node.name for path in SOURCES for node in nodes_of(path) if isinstance(node, ast.ClassDef)
    )
    assert {name: count for name, count in names.items() if count > 1} == {}


def test_only_the_command_prints():
    """The library returns, warns, raises and sends events; `tetopt.cli` alone writes to the
    terminal.
    """
    printing, streams = {"print", "pprint", "print_exc", "print_exception"}, {"stdout", "stderr"}
    printed = [
        f"{module_name(path)}:{node.lineno}"
        for path in SOURCES
        if "cli" not in path.parts
        for node in nodes_of(path)
        if (
            isinstance(node, ast.Call)
            and getattr(node.func, "id", getattr(node.func, "attr", "")) in printing
        )
        or (
            isinstance(node, ast.Attribute)
            and node.attr in streams
            and getattr(node.value, "id", "") == "sys"
        )
    ]
    assert printed == []


def test_mutants_are_of_code_and_tests_that_are_there():
    """`tests/mutants/run.py` changes a text that a file has once, and runs tests that exist."""
    stale = []
    for path in (ROOT / "tests" / "mutants").glob("*.toml"):
        for mutant in tomllib.loads(text_of(path))["mutant"]:
            names = [
                mutant["file"],
                *(word for word in mutant["tests"].split() if word.endswith(".py")),
            ]
            is_there = all((ROOT / name).is_file() for name in names)
            if not is_there or text_of(ROOT / names[0]).count(mutant["old"]) != 1:
                stale.append((path.name, mutant["file"], mutant["old"]))
    assert stale == []
