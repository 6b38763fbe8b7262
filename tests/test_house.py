"""The structure: no two files import each other in a circle, no folder is crowded, links lead somewhere."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("diffuserbench", "recon", "drivers", "instrument", "calibration_routines", "gui")
MOST_MODULES = 25

BACK = {
    "calibration_routines.procedure": {
        "calibration_routines.psf.sweep_plan",
        "calibration_routines.psf.sweep_watch",
    },
    "calibration_routines.times": {"calibration_routines.procedure"},
    "drivers.common.stream": {"drivers.camera"},
    "drivers.common.stream_reader": {"drivers.common.stream"},
    "drivers.illuminate.sequencer": {"drivers.illuminate.led_array"},
    "drivers.simulated.living": {"drivers.simulated.world"},
    "recon.evaluation.chart_judge": {"recon.evaluation.chart_reconstruction"},
    "recon.reconstruction.problem": {"recon.reconstruction.choice", "recon.reconstruction.reduction"},
    "recon.reconstruction.result": {
        "recon.reconstruction.choice",
        "recon.reconstruction.problem",
        "recon.reconstruction.psf_refinement",
        "recon.reconstruction.uncertainty",
    },
    "recon.reconstruction.solvers": {"recon.reconstruction.part", "recon.reconstruction.problem"},
}
"""What modules name in annotations alone, and which needs them: parts know the whole that makes them, what
passes through a reconstruction knows its stations."""


def module_files(root: Path) -> dict[str, Path]:
    """Return the packages' modules by their dotted names."""
    found = {}
    for package in PACKAGES:
        for path in (root / package).rglob("*.py"):
            found[".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")] = path
    return found


@cache
def parsed(path: Path) -> ast.Module:
    """Return a file's syntax tree."""
    return ast.parse(path.read_text("utf-8"))


def imported(tree: ast.Module, *, types: bool = False) -> Iterator[str]:
    """Yield what a module imports, inside functions too; what only type checkers see with ``types`` alone."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if not types and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        waiting += ast.iter_child_nodes(node)


def import_graph(files: Mapping[str, Path], *, types: bool = False) -> dict[str, set[str]]:
    """Return which modules each module imports; a package's face hands names on and counts as no module."""
    graph = {}
    for name, path in files.items():
        names = {n for n in imported(parsed(path), types=types) if n in files and n != name}
        graph[name] = {n for n in names if files[n].name != "__init__.py"}
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that reach each other."""
    reach = {name: _reached(graph, name) for name in graph}
    groups = {frozenset({a, *(b for b in reach[a] if a in reach.get(b, ()))}) for a in graph if a in reach[a]}
    return sorted(sorted(group) for group in groups)


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += graph[name]
    return seen


def test_no_two_files_import_each_other_in_a_circle() -> None:
    assert circles(import_graph(module_files(ROOT))) == []


def back(files: Mapping[str, Path]) -> dict[str, set[str]]:
    """Return what each module imports for its annotations alone, though that needs the module."""
    runs, whole = import_graph(files), import_graph(files, types=True)
    reach = {name: _reached(whole, name) for name in whole}
    found = {name: {n for n in whole[name] - runs[name] if name in reach[n]} for name in whole}
    return {name: names for name, names in found.items() if names}


def test_annotations_close_no_more_circles() -> None:
    assert back(module_files(ROOT)) == BACK, "move the type, or what is made of it, to where both can use it"


def test_no_package_imports_its_own_modules() -> None:
    """Two threads, one importing a package and the other a module of it, would wait for each other."""
    found = {}
    for name, path in module_files(ROOT).items():
        if path.name == "__init__.py":
            own = [
                n.module
                for n in parsed(path).body
                if isinstance(n, ast.ImportFrom)
                and (n.module or "").startswith(f"{name}.")
                and n.module != "recon.base.handed_on"
            ]
            if own:
                found[name] = own
    # The window's table of panels is imported whole before the first of its threads starts.
    assert found == {"gui.panels": ["gui.panels.unserved"]}, "hand its names on: recon.base.handed_on"


def test_no_folder_is_crowded() -> None:
    counts: dict[Path, int] = {}
    for path in module_files(ROOT).values():
        counts[path.parent] = counts.get(path.parent, 0) + (path.name != "__init__.py")
    crowded = {str(d.relative_to(ROOT)): n for d, n in counts.items() if n > MOST_MODULES}
    assert not crowded, (
        f"more than {MOST_MODULES} modules: split the room, or merge what has one reason to change"
    )


def headings(page: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", found) for found in re.findall(r"^#+ (.*)$", page, re.M))
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in plain}


def test_types_of_arrays_have_one_home() -> None:
    home = module_files(ROOT)["recon.arrays"]
    there = {ast.unparse(node.value) for node in parsed(home).body if isinstance(node, ast.Assign)}
    again = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for name, path in module_files(ROOT).items()
        if path != home and (name.startswith("drivers.simulated") or not name.startswith("drivers"))
        for node in parsed(path).body
        if isinstance(node, ast.Assign) and ast.unparse(node.value) in there
    ]
    assert not again, f"recon.arrays has it: {again}"


def test_every_link_between_pages_leads_somewhere() -> None:
    lost = []
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        for link in re.findall(r"\]\(([^)\s:]+)\)", page.read_text(encoding="utf-8")):
            name, _, anchor = link.partition("#")
            there = page.parent / name if name else page
            if not there.exists() or (anchor and anchor not in headings(there.read_text(encoding="utf-8"))):
                lost.append(f"{page.relative_to(ROOT)}: {link}")
    assert lost == []


def test_every_page_is_in_the_list_of_pages() -> None:
    """Decisions have an index of their own; what a benchmark writes is shown on its page."""
    docs = ROOT / "docs"
    listed = (docs / "README.md").read_text("utf-8")
    pages = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    unlisted = sorted(page for page in pages if f"]({page}" not in listed and "decisions/" not in page)
    assert unlisted == ["README.md", "benchmarks/auto-model-table.md"], "add a line to docs/README.md"


def defined(path: Path) -> set[str]:
    """Return what a module's own lines name."""
    found = set()
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            found |= {n.id for n in ast.walk(target) if isinstance(n, ast.Name)} if target else set()
    return found


def test_code_that_panels_copy_imports_names_from_where_they_are() -> None:
    files, lost, count = module_files(ROOT), [], 0
    for path in (ROOT / "gui").rglob("*.py"):
        for node in ast.walk(parsed(path)):
            match node:
                case ast.Tuple(elts=[ast.Constant(str(module)), ast.Constant(str(name))]) if module in files:
                    count += 1
                    if files[module].name != "__init__.py" and name not in defined(files[module]):
                        lost.append(f"{path.relative_to(ROOT)}: from {module} import {name}")
    assert lost == []
    assert count > 10


def test_what_benchmarks_import_is_there() -> None:
    """They are run by hand, some of them for hours: names that moved would be noticed then."""
    files, lost, count = module_files(ROOT), [], 0
    for path in (*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "examples").rglob("*.py")):
        for node in ast.walk(parsed(path)):
            home = files.get(getattr(node, "module", None) or "")
            if not isinstance(node, ast.ImportFrom) or home is None or home.name == "__init__.py":
                continue
            there = defined(home) | {name.rpartition(".")[2] for name in imported(parsed(home), types=True)}
            lost += [f"{path.name}: {node.module}.{a.name}" for a in node.names if a.name not in there]
            count += 1
    assert lost == []
    assert count > 300


def test_benchmarks_that_are_programs_find_what_lies_beside_them() -> None:
    """Without PYTHONPATH; those that are imported by one find it by that one."""
    lost = []
    for path in (ROOT / "benchmarks").glob("*.py"):
        text = path.read_text("utf-8")
        beside = re.search(r"^from (benchmarks|tests)\b", text, re.M)
        made = re.search(r"^sys\.path\.", text, re.M)
        if beside and "__main__" in text and not (made and made.start() < beside.start()):
            lost.append(path.name)
    assert lost == []


DECISIONS = ROOT / "docs" / "decisions"
HOLD = re.compile(r"\* \[(\d{4})\]\((\S+)\) (?:~~)?(.*?)(?:~~)?(?: \((?:in part )?now (.*)\))?")
"""A line of the index: a decision, its heading, and what replaced it or parts of it."""
REPLACES = re.compile(r"\b(?:replaces|amends|mends|takes back)\b[^.;]*?\[0*(\d+)\]", re.I)


def numbers(lines: str | None) -> set[str]:
    """Return the numbers of the decisions that lines link to."""
    return set(re.findall(r"\[(\d{4})\]", lines or ""))


def test_every_decision_is_in_the_index_with_what_replaced_it() -> None:
    index = (DECISIONS / "README.md").read_text("utf-8")
    rows = [HOLD.fullmatch(line) for line in index.splitlines() if line.startswith("* ")]
    assert None not in rows, "a line is: * [NNNN](file) heading (in part now [NNNN](file))"
    listed = [(row[2], row[3].lower()) for row in rows if row is not None]
    texts = {path.name: path.read_text("utf-8") for path in DECISIONS.glob("[0-9]*.md")}
    headings = {name: re.sub(r"^# [\d.]+:? *", "", text.splitlines()[0]) for name, text in texts.items()}
    assert sorted(listed) == sorted((name, heading.lower()) for name, heading in headings.items()), (
        "give the new decision a line of docs/decisions/README.md, under its subject, with its heading"
    )
    after = {row[1]: numbers(row[4]) for row in rows if row is not None}
    for name, text in texts.items():
        for found in REPLACES.findall(" ".join(text.splitlines()[:6])):
            assert name[:4] in after[found.zfill(4)], f"{name} replaces a part of {found}: say so behind that"


@pytest.mark.parametrize("inside", [False, True])
def test_a_circle_is_found(tmp_path: Path, inside: bool) -> None:
    (tmp_path / "recon").mkdir()
    one, two = tmp_path / "recon" / "one.py", tmp_path / "recon" / "two.py"
    one.write_text("from recon import two\n")
    two.write_text("def later():\n    import recon.one\n" if inside else "from recon.one import two\n")
    assert circles(import_graph(module_files(tmp_path))) == [["recon.one", "recon.two"]]


def test_a_circle_of_annotations_is_found(tmp_path: Path) -> None:
    (tmp_path / "recon").mkdir()
    one, two = tmp_path / "recon" / "one.py", tmp_path / "recon" / "two.py"
    one.write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from recon.two import Two\n")
    two.write_text("import recon.one\n")
    files = module_files(tmp_path)
    assert circles(import_graph(files)) == []
    assert back(files) == {"recon.one": {"recon.two"}}
