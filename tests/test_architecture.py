"""Which room may import which: the table of docs/architecture.md, held against the import graph of the code."""

from __future__ import annotations

import graphlib
import re
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "architecture.md"

Table = dict[str, set[str]]


def read_table() -> Table:
    """Room -> the rooms it may import, beside itself and the base."""
    cells = re.compile(r"^\| `([\w/]+)` \| .* \|([^|]*)\|$", re.MULTILINE)
    rows = cells.findall(DOCUMENT.read_text(encoding="utf-8").partition("## The rooms")[2])
    return {room: set(re.findall(r"`([\w/]+)`", allowed)) for room, allowed in rows}


def room_of(module: str, table: Table) -> str:
    """The room of a module: "scene" of splashbench.scene.camera, "face" of splashbench itself."""
    package, *parts = module.split(".")
    if package == "splashbench_methods":
        return f"methods/{parts[0]}" if parts else "methods"
    if not parts or parts == ["__main__"]:
        return "face"
    return parts[0] if parts[0] in table else "base"


def breaches(graph: grimp.ImportGraph, table: Table) -> list[str]:
    """Imports that the table does not allow, one line each."""
    lines = []
    for importer in sorted(graph.modules):
        room = room_of(importer, table)
        if room == "face":  # offers the public names of other rooms
            continue
        allowed = {room, "base", *table.get(room, ())}
        if room.startswith("methods/"):
            allowed.add("face")
        for imported in sorted(graph.find_modules_directly_imported_by(importer)):
            target = room_of(imported, table)
            if target not in allowed:
                lines.append(f"{importer} imports {imported}, but {room} may not import {target}")
    return lines


def circle(graph: grimp.ImportGraph) -> list[str]:
    """The modules of one circle of imports, or nothing."""
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    imports.pop("splashbench")  # imports its public names only when they are asked for
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


@pytest.fixture(scope="module")
def table() -> Table:
    return read_table()


@pytest.fixture
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("splashbench", "splashbench_methods", cache_dir=None)


def test_every_import_is_one_that_the_architecture_allows(graph: grimp.ImportGraph, table: Table) -> None:
    assert breaches(graph, table) == []


def test_no_file_imports_in_a_circle(graph: grimp.ImportGraph) -> None:
    assert circle(graph) == []


def test_the_table_names_every_room_and_no_other(graph: grimp.ImportGraph, table: Table) -> None:
    folders = {path.parent.name for path in (ROOT / "splashbench").glob("*/__init__.py")}
    methods = {f"methods/{path.parent.name}" for path in (ROOT / "methods").glob("*/__init__.py")}
    assert set(table) == (folders - {"files"}) | methods | {"base"}  # `files` is a folder of the base
    assert {target for allowed in table.values() for target in allowed} <= set(table)


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("splashbench.scene.camera", "splashbench.render.cpu"),  # upwards
        ("splashbench.harness.runner", "splashbench.score.protocol"),  # sideways
        ("splashbench.errors", "splashbench.scene.camera"),  # out of the base
        ("splashbench.harness.discovery", "splashbench_methods.hull_points.hull_points"),  # a method
        ("splashbench_methods.deformable_3dgs.model", "splashbench_methods.scaffold_4d.model"),  # another method
    ],
)
def test_a_breach_is_reported(graph: grimp.ImportGraph, table: Table, importer: str, imported: str) -> None:
    assert {importer, imported} <= graph.modules
    graph.add_import(importer=importer, imported=imported)
    assert [line for line in breaches(graph, table) if line.startswith(f"{importer} imports {imported},")] != []


def test_a_circle_is_reported(graph: grimp.ImportGraph) -> None:
    graph.add_import(importer="splashbench.scene.camera", imported="splashbench.scene.scene")
    graph.add_import(importer="splashbench.scene.scene", imported="splashbench.scene.camera")
    assert {"splashbench.scene.camera", "splashbench.scene.scene"} <= {*circle(graph)}
