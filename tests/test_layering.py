"""The layers of docs/conventions.md as a test. Sources are read with `ast`; nothing of the package is imported."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SRC = ROOT / "delo_jax"
PAGE = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
LAYERS = {part: int(layer) for layer, part in re.findall(r"^\| (\d+) \| `(\w+)` \|", PAGE, flags=re.M)}
CONFINED = dict(re.findall(r"^\| `(\w+)` \| `(\w+)` \|$", PAGE, flags=re.M))
FROM_ANYWHERE = {"errors", "config"}
WITHOUT_JAX = {"errors", "config", "data"}
FRONT_DOORS = {SRC / "__init__.py", SRC / "__main__.py"}  # they may open every room
SOURCES = [path for path in sorted(SRC.rglob("*.py")) if path not in FRONT_DOORS]


def part_of(path):
    """`geometry` of delo_jax/geometry/se3.py, `config` of delo_jax/config.py."""
    return path.relative_to(SRC).parts[0].removesuffix(".py")


def imported_modules(path):
    """Full names of everything a file imports, at its top or inside a function."""
    package = ["delo_jax", *path.relative_to(SRC).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, [start, node.module]))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def imported_parts(path):
    """Parts of this package that a file imports; the public names of the front door count as one part."""
    for name in imported_modules(path):
        words = name.split(".")
        if words[0] == "delo_jax" and name != "delo_jax.__version__":
            yield words[1] if len(words) > 1 and words[1] in LAYERS else "the package itself"


def test_the_page_lists_every_part():
    """Oracle: the folders and files that are there."""
    assert LAYERS["errors"] == 0
    assert LAYERS["cli"] == max(LAYERS.values())
    assert {part_of(path) for path in SOURCES} <= LAYERS.keys()
    assert CONFINED["flax"] == "model"


def test_imports_only_point_down():
    """Oracle: the table of docs/conventions.md; the front door's public names are above all but the command line."""
    front_door = max(LAYERS.values()) - 0.5
    upward = [
        f"{path.relative_to(ROOT)} imports {part}"
        for path in SOURCES
        for part in imported_parts(path)
        if part not in FROM_ANYWHERE | {part_of(path)} and LAYERS.get(part, front_door) >= LAYERS[part_of(path)]
    ]
    assert not upward


def test_confined_packages_stay_where_they_are():
    """Oracle: the second table of docs/conventions.md, and its sentence on jax."""
    astray = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in SOURCES
        for name in imported_modules(path)
        if CONFINED.get(name.split(".")[0], part_of(path)) != part_of(path)
        or (name.split(".")[0] in {"jax", "jaxlib"} or name == "jaxtyping.Array")
        and part_of(path) in WITHOUT_JAX
    ]
    assert not astray


def test_no_module_hides_the_function_or_another_package():
    """Oracle: `delo_jax.odometry` is a function, and a file at the top of the checkout would shadow its namesake."""
    assert not [path for path in SRC.rglob("odometry*") if path.stem == "odometry"]
    assert not [path for path in ROOT.glob("*.py") if path.stem in sys.stdlib_module_names]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import delo_jax.geometry.se3", "geometry"),
        ("from delo_jax.ops import knn", "ops"),
        ("from delo_jax import model", "model"),
        ("from delo_jax import odometry", "the package itself"),
        ("import delo_jax", "the package itself"),
        ("from ..train import step", "train"),
        ("def f():\n    from . import cull", "sim"),
        ("from delo_jax import __version__", None),
        ("import numpy", None),
    ],
)
def test_every_form_of_import_is_seen(source, expected, tmp_path, monkeypatch):
    """Oracle: by hand, for a file that would stand in delo_jax/sim."""
    monkeypatch.setattr(sys.modules[__name__], "SRC", tmp_path)
    path = tmp_path / "sim" / "scan.py"
    path.parent.mkdir()
    path.write_text(source)
    assert list(imported_parts(path)) == ([] if expected is None else [expected])
