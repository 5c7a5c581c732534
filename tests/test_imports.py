"""Imports between packages and between the offline rooms go one way: read from the sources, nothing is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "palpate_client": ROOT / "client" / "palpate_client",
    "palpate_view": ROOT / "client" / "palpate_view",
    "palpate_server": ROOT / "server" / "palpate_server",
    "palpate": ROOT / "offline" / "palpate",
    "palpate_paper": ROOT / "offline" / "palpate_paper",
}

ALLOWED = {
    "palpate_client": ("palpate.files",),
    "palpate_view": ("palpate_client",),
    "palpate_server": (
        "palpate_client.wire",
        "palpate_client.messages",
        "palpate.model_file",
        "palpate.files",
    ),
    "palpate": (),
    "palpate_paper": ("palpate",),
}
"""What a package may import of the others: these modules and what is inside them."""

PROGRAMS = {
    "palpate_server.__main__": ("palpate_client.arguments",),
    "palpate_server.recording.record": ("palpate_client",),
    "palpate_server.recording.replay": ("palpate_client.arguments",),
    "palpate_server.diagnostics": ("palpate_client",),
    "palpate.demo": ("palpate_client", "palpate_server.simulation"),
    "palpate.notebook": ("palpate_server.simulation",),
    "palpate.cli": ("palpate_client",),
    "palpate.commands": ("palpate_client",),
    "palpate.versions": ("palpate_client",),
}
"""What some may import beside that: these programs are clients themselves."""

LAZY = {("palpate.cli", "palpate_paper.reproduce"), ("palpate.commands", "palpate_paper.reproduce")}
"""Imported inside a function only, so that the product runs without it."""

ROOMS = (
    "files",
    "memory",
    "progress",
    "interrupts",
    ("model_file", "lti.pole_residue"),  # the file holds a linear system: on one level
    "scene",
    "geometry",
    "inclusions",
    "scene_cloud",
    "thin_parts",
    "factorization",
    "meshfree",
    "discretization",
    "modes",
    "lti",
    "reduction",
    "surface_model",
    "stage_cache",
    "stage_keys",
    "expected",
    "build",
    "build_surface",
    "expected_surface",
    "bank",
    "report",
    "plots",
    "surface_plots",
    "notebook",
    "fitting",
    "stages",
    "demo",
    "commands",
    "versions",
    "cli",
    "completion",
    "__main__",
)
"""The offline rooms, in the order of the chain: a room imports those before it, and those on its level."""


SERVER_ROOMS = (
    ("errors", "arguments"),
    (
        "realtime",
        "bodies",
        "coupling",
    ),  # the loop: the tick calls the coupling, which uses what the loop compiles with
    "simulation",
    "codec",
    "recording",
    "session",
    "diagnostics",
    "__main__",
)
"""The server's rooms, in order: a room imports those before it, and those on its level."""


@dataclass(frozen=True)
class Import:
    importer: str
    imported: str
    line: int
    in_function: bool

    def __str__(self) -> str:
        return f"{self.importer}:{self.line} imports {self.imported}"


def imports_of(module: str, source: str, packages: tuple[str, ...] = tuple(PACKAGES)) -> list[Import]:
    """The imports of our own packages in a module's source."""
    tree = ast.parse(source)
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{module}:{node.lineno}: a relative import"
            # `from package import module` names the module; `from module import name` names something inside it.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        found += [
            Import(module, name, node.lineno, id(node) in inside)
            for name in names
            if name.split(".")[0] in packages
        ]
    return found


def modules() -> Iterator[tuple[str, Path]]:
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            yield ".".join((package, *(p for p in parts if p != "__init__"))), path


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def between_packages(i: Import) -> bool:
    """Whether an import of another package is one of those that are allowed."""
    package, other = i.importer.split(".")[0], i.imported.split(".")[0]
    if package == other:
        return True
    if any(within(i.importer, program) and within(i.imported, module) for program, module in LAZY):
        return i.in_function
    more = [m for program, allowed in PROGRAMS.items() if within(i.importer, program) for m in allowed]
    return any(within(i.imported, m) for m in (*ALLOWED[package], *more))


def room(name: str) -> int:
    """The place of a module in its package's list of rooms: that of the longest name that it is within."""
    package, _, inner = name.partition(".")
    rooms: tuple[str | tuple[str, ...], ...] = SERVER_ROOMS if package == "palpate_server" else ROOMS
    levels = {r: i for i, level in enumerate(rooms) for r in ([level] if isinstance(level, str) else level)}
    fitting = [r for r in levels if within(inner, r)]
    assert fitting, f"{name} is in no room: put it into the list of rooms where it belongs"
    return levels[max(fitting, key=len)]


def along_the_chain(i: Import) -> bool:
    return room(i.importer) >= room(i.imported)


@pytest.fixture(scope="module")
def all_imports() -> list[Import]:
    return [i for module, path in modules() for i in imports_of(module, path.read_text(encoding="utf-8"))]


def test_packages_import_each_other_one_way(all_imports: list[Import]) -> None:
    assert len({i.importer.split(".")[0] for i in all_imports}) == len(PACKAGES)
    assert [str(i) for i in all_imports if not between_packages(i)] == []


@pytest.mark.parametrize("package", ["palpate", "palpate_server"])
def test_the_rooms_of_a_package_import_one_way(package: str, all_imports: list[Import]) -> None:
    inside = [
        i
        for i in all_imports
        if within(i.importer, package) and within(i.imported, package) and i.importer != package
    ]
    assert len(inside) > 50
    assert [str(i) for i in inside if not along_the_chain(i)] == []


@pytest.mark.parametrize(
    ("module", "source", "allowed"),
    [
        ("palpate_client.tool", "import palpate_server.codec", False),
        ("palpate_client.tool", "from palpate import model_file", False),
        ("palpate_view.session", "from palpate_server.session import leases", False),
        ("palpate_view.session", "from palpate_client import Connection", True),
        ("palpate_server.session.server", "from palpate_client.wire import KEYS", True),
        ("palpate_server.session.server", "from palpate_client import Connection", False),
        ("palpate_server.session.server", "from palpate.reduction import reduce", False),
        ("palpate_server.session.server", "def f():\n    import palpate.build", False),
        ("palpate_server.recording.record", "from palpate_client import Connection", True),
        ("palpate.build", "if TYPE_CHECKING:\n    from palpate_paper.study import Study", False),
        ("palpate.cli", "from palpate_paper.reproduce import reproduce", False),
        ("palpate.cli", "def f():\n    from palpate_paper.reproduce import reproduce", True),
        ("palpate.cli", "def f():\n    from palpate_paper.study import Study", False),
    ],
)
def test_a_wrong_import_between_packages_is_found(module: str, source: str, allowed: bool) -> None:
    (found,) = imports_of(module, source)
    assert between_packages(found) is allowed


@pytest.mark.parametrize(
    ("module", "source", "allowed"),
    [
        ("palpate.modes.dense", "from palpate.discretization.assembled_body import AssembledBody", True),
        ("palpate.discretization.conservative", "from palpate.modes.dense import elastic_modes", False),
        ("palpate.lti.block_form", "from palpate.model_file import StateSpace", True),
        ("palpate.model_file.types", "from palpate.lti.pole_residue import PoleResidueSystem", True),
        ("palpate.model_file.types", "from palpate.lti.block_form import to_block_form", False),
        ("palpate.lti.pole_residue", "from palpate.scene.material import Material", False),
        ("palpate_server.recording.recorder", "from palpate_server.session.leases import Leases", False),
        ("palpate_server.realtime.tick", "from palpate_server import coupling", True),
    ],
)
def test_a_wrong_import_between_rooms_is_found(module: str, source: str, allowed: bool) -> None:
    (found,) = imports_of(module, source)
    assert along_the_chain(found) is allowed
